"""Pictures of grasps and of convergence."""
