"""Kinematics as CasADi graphs: joints, couplings, contact conditions, arms in closed form."""
