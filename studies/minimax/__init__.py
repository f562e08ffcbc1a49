"""How nearly contacts can be met at all: by Ipopt, sharing nothing but the kinematics."""
