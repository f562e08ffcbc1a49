"""Parameters of the fits in `casadi_ik.kinematics.contact_fit`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FitParameters:
    """Damping and convergence criteria of a fit.

    Attributes:
        damping: Initial damping of the normal matrix, whose rows are of order one per radian and
            0.1 m.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends the fit.
        damping_down: Smallest factor of the damping after an accepted step.
        growth: Factor of the damping after a rejected step; doubles with every further rejection.
        slow: Ratio of costs after and before a step above which progress is slow.
        quadratic: Ratio of costs below which convergence is fast, so that another step pays.
        patience: Number of consecutive steps with slow progress that ends the fit.
        budget: Maximum number of steps.
        promising: Cost below which `patience` and `budget` are multiplied by `persistence`.
        persistence: Factor of the effort for fits near a solution.
        exact: Square root of the cost below which contacts are met exactly (0.1 nm per 100 mm, or
            rad).
        fine: Fraction of the tolerance below which errors count as exact.
        passes: Number of corrections of the active set in a step.
    """

    damping: float = 1e-3
    damping_floor: float = 1e-12
    damping_ceiling: float = 1e4
    damping_down: float = 1 / 8
    growth: float = 4.0
    slow: float = 0.9
    quadratic: float = 0.1
    patience: int = 3
    budget: int = 15
    promising: float = 1e-3
    persistence: int = 10
    exact: float = 1e-8
    fine: float = 1e-3
    passes: int = 2


@dataclass(frozen=True)
class MinimaxParameters:
    """Parameters of the minimax stage, which reduces the largest error relative to its tolerance.

    Attributes:
        powers: Successive exponents p of the p-norm of the error ratios.
        max_tolerance_ratio: Largest ratio of error to tolerance from which the minimax stage
            starts.
        same_cost_tolerance: Relative difference of costs below which two minima are the same.
        stall_ratio: Ratio of sums after and before a step above which the next power begins.
        infeasible_ratio: If the sum stalls above n * infeasible_ratio**power for n errors, the
            largest error cannot fall below its tolerance near this configuration.
        improvement_ratio: Ratio of the largest errors of two minimax fits above which the second is
            no improvement.
        budget: Maximum number of steps.
        damping: Factor of the damping relative to a fit, because rows are divided by tolerances.
        damping_floor: Smallest damping of a fit.
        damping_ceiling: Damping at which the next power begins.
        damping_decrease: Factor of the damping after an accepted step.
        damping_increase: Factor of the damping after a rejected step.
        max_growth: Error ratio, relative to the largest before the step, at which ratios saturate.
    """

    powers: tuple[float, ...] = (4.0, 10.0, 24.0, 60.0, 150.0, 400.0)
    max_tolerance_ratio: float = 2.0
    same_cost_tolerance: float = 1e-2
    stall_ratio: float = 0.95
    infeasible_ratio: float = 1.05
    improvement_ratio: float = 0.99
    budget: int = 60
    damping: float = 100.0
    damping_floor: float = 1e-8
    damping_ceiling: float = 10.0
    damping_decrease: float = 1 / 8
    damping_increase: float = 4.0
    max_growth: float = 2.0


@dataclass(frozen=True)
class TolerantFitParameters:
    """Parameters of a fit of the errors beyond the tolerances.

    Attributes:
        free_fraction: Fraction of the tolerance within which an error costs nothing.
        max_start_ratio: Largest `tolerance_ratio` at a minimum of the exact fit from which a
            tolerant fit starts.
        near_miss_ratio: Largest `tolerance_ratio` at which a minimum counts as a near miss.
        patience: Number of consecutive steps with slow progress that ends the fit.
        budget: Maximum number of steps.
    """

    free_fraction: float = 0.95
    max_start_ratio: float = 1.0
    near_miss_ratio: float = 2.0
    patience: int = 4
    budget: int = 40


FIT, MINIMAX, TOLERANT_FIT = FitParameters(), MinimaxParameters(), TolerantFitParameters()
