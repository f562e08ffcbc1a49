"""Numbers of the hand-first method."""

from __future__ import annotations

from dataclasses import dataclass

from casadi_ik.errors import InputError


@dataclass(frozen=True)
class HandFirstParameters:
    """Parameters of the method.

    Attributes:
        table: Hand postures the targets' shapes are compared with; of hands with few motors and
            more than three fingers fewer (`restarts.FEWER_ROWS`).
        candidates: Of those, how many a round of the compiled loop may start from.
        wide_table: The same for the rounds after the first.
        rounds: Rounds that begin from the tables, each from the next best candidates. After them
            some begin elsewhere (`restarts.later`), before a target is given up.
        max_rounds: Rounds of all kinds at most, each of up to `candidates` hand postures: the limit
            of effort. 1 solves nearly all that can be reached. None: as many as may help.
    """

    table: int = 1024
    candidates: int = 8
    wide_table: int = 8192
    rounds: int = 6
    max_rounds: int | None = None

    def __post_init__(self) -> None:
        for name in ("table", "candidates", "wide_table", "rounds", "max_rounds"):
            value = getattr(self, name)
            if name == "max_rounds" and value is None:
                continue
            if isinstance(value, bool) or not (isinstance(value, int) and value >= 1):
                raise InputError(f"{name}: found {value!r}, expected a whole number >= 1")
        if self.candidates * self.rounds > self.table:
            raise InputError(
                f"table: found {self.table}, expected at least candidates x rounds = "
                f"{self.candidates * self.rounds}"
            )
