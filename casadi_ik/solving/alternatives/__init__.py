"""Several solutions of a grasp, and moving grasps."""
