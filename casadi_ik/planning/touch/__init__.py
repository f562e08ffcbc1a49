"""Grasp synthesis: from the surface of an object to grasps that an arm-hand can reach."""
