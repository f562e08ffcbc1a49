"""Why a grasp cannot be solved."""
