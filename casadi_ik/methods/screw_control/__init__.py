"""The screw control law of Chandra et al. 2019."""
