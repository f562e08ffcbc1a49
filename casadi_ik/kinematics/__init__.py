"""Kinematics as CasADi graphs: forward kinematics, couplings, contact conditions, arms in closed form."""
