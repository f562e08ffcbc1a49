"""The whole arm-hand as one nonlinear program, the slow reference."""
