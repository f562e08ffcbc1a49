"""Robots that move: targets followed cycle by cycle, motions along paths, ways to a grasp."""
