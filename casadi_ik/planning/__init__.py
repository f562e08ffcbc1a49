"""Choice among grasps, and grasps of object surfaces."""
