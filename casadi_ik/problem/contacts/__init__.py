"""What a contact asks of a fingertip: its kinds, their residuals, Jacobians, errors, tolerances."""
