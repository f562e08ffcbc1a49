"""Other people's files (URDF, xacro, MJCF) as trees of joints, and trees as parts of a robot."""
