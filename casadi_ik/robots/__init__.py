"""What the robot is: frozen data from YAML, numpy only."""
