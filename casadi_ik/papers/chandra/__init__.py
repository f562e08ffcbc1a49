"""Chandra et al. 2019: screw control of the AR10 hand, and its calibration."""
