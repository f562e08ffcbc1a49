"""How the robot moves: pure CasADi graphs, nothing solved."""
