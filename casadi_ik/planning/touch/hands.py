"""Records of the grasp search (parameters, hands, contacts), and its compiled drivers."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.codegen import WIDE, define, driver_text
from casadi_ik.compile.function_kernel import machine_lanes
from casadi_ik.compile.libraries import load_library
from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.reprs import RecordReprMixin


@dataclass(frozen=True)
class TouchParameters:
    """Parameters of the grasp search.

    Attributes:
        max_facing_angle: Two patches oppose each other if both normals are within this angle of the
            line between them [rad].
        pairs_per_draw: Number of pairs of patches drawn at once.
        first_batch: Candidates generated in the first batch.
        max_batch: Maximum number of candidates generated in one batch.
        max_attempts_per_batch: Maximum number of attempts for one batch; an attempt is a pair of
            fingertips matched with a pair of patches.
        max_attempts: Maximum number of attempts in total.
        max_consecutive_duplicates: Stop generating after this many duplicates in a row.
        max_unreachable_hands: Give up after this many hand poses if the arm reached none.
        min_trial_probability: Minimum probability of trying a palm depth or direction, relative to
            the one that was most often free of collision.
        max_pinch_depth: Saturation of the depth score: distance of the pinch midpoint from the
            palm [m].
        object_cell: Minimum edge of the cells of the object's distance grid [m].
        scene_cell: Minimum edge of the cells of the scene's distance grid [m].
        max_cells: Approximate maximum number of cells along an edge of either grid.
        max_initial_lean: Maximum lean of a plane pad before refinement [rad]; balls may lean more.
        max_initial_height: Maximum distance of a further fingertip from the surface before
            refinement [m].
        idle_clearance: Minimum distance from the surface of fingertips without contact [m].
        max_posture_trials: Maximum number of postures of a further finger checked for collision.
        refinement_steps: Number of damped least-squares steps on palm and hand.
        free_lean: Lean of a plane pad up to which the refinement adds no cost [rad].
        sliding_weight: Weight of sliding along the surface, relative to distance from it.
        lean_length: Length whose cost equals that of a lean of 1 rad [m].
        max_height: Maximum distance of a pad from the surface in a grasp [m].
        max_spread: Maximum angle between the mean normal at a contact and the normals of its
            triangles, and the direction in which the pad meets them [rad]; beyond this the
            contact is on an edge.
        max_lean: Maximum lean of a plane pad in a grasp [rad].
        min_separation: Grasps are distinct if a fingertip or the palm differs by more than
            this [m].
        min_rotation: Grasps are distinct if the palm is rotated by more than this [rad].
    """

    max_facing_angle: float = float(np.deg2rad(45.0))
    pairs_per_draw: int = 40_000
    first_batch: int = 24
    max_batch: int = 2000
    max_attempts_per_batch: int = 100_000
    max_attempts: int = 1_000_000
    max_consecutive_duplicates: int = 3000
    max_unreachable_hands: int = 300
    min_trial_probability: float = 0.03
    max_pinch_depth: float = 0.2
    object_cell: float = 5e-3
    scene_cell: float = 25e-3
    max_cells: int = 36
    max_initial_lean: float = float(np.deg2rad(25.0))
    max_initial_height: float = 8e-3
    idle_clearance: float = 8e-3
    max_posture_trials: int = 24
    refinement_steps: int = 4
    free_lean: float = float(np.deg2rad(8.0))
    sliding_weight: float = 0.25
    lean_length: float = 0.02
    max_height: float = 1e-3
    max_spread: float = float(np.deg2rad(20.0))
    max_lean: float = float(np.deg2rad(15.0))
    min_separation: float = 0.010
    min_rotation: float = float(np.deg2rad(15.0))


@dataclass(frozen=True)
class TipContacts:
    """Contacts of fingertips with the triangles of a surface, object frame.

    Attributes:
        foot: (k, f, 3) nearest points of the surface [m].
        inward: (k, f, 3) unit normals into the object: means over the triangles at a contact.
        normal_spread: (k, f) maximum angle between this mean and the normals of its triangles
            [rad].
        direction: (k, f, 3) unit directions in which pads meet the surface.
        height: (k, f) distances of pads from the surface [m], negative inside.
        lean: (k, f) maximum angle between a pad normal and the inward normals [rad].
    """

    foot: Array
    inward: Array
    normal_spread: Array
    direction: Array
    height: Array
    lean: Array

    def rows(self, rows: NDArray) -> TipContacts:
        """Return the contacts of the hands with the given row numbers."""
        return TipContacts(*(getattr(self, column.name)[rows] for column in fields(self)))

    def accepted(self, parameters: TouchParameters, roll: Array) -> Bools:
        """Return (k, f) True for pads whose contact is within the limits of a grasp.

        Args:
            parameters: Limits of distance and lean.
            roll: (f,) additional lean permitted for each pad [rad].
        """
        off_normal = np.arccos(np.clip((self.direction * self.inward).sum(axis=-1), -1, 1))
        touches: Bools = np.abs(self.height) < parameters.max_height
        touches &= self.lean < parameters.max_lean + roll
        return touches & (np.maximum(self.normal_spread, off_normal) < parameters.max_spread)


@dataclass(frozen=True, eq=False, repr=False)
class HandCandidates(RecordReprMixin):
    """Palm poses and hand postures of k candidates, in the object's frame.

    Attributes:
        palm: (k, 4, 4) poses of the palm.
        hand: (k, m) positions of the fingers' motors [rad or m].
        touches: (k, f) True for fingers that touch the object.
        tips: (k, f, 3) fingertips [m]; empty if they were not computed.
        contacts: Contacts with the surface; None if they were not computed.
    """

    palm: Array
    hand: Array
    touches: Bools
    tips: Array = field(default_factory=lambda: np.zeros(0))
    contacts: TipContacts | None = None

    def __len__(self) -> int:
        return len(self.hand)

    def rows(self, rows: NDArray) -> HandCandidates:
        """Return the candidates with the given row numbers."""
        tips = self.tips[rows] if len(self.tips) else self.tips
        contacts = None if self.contacts is None else self.contacts.rows(rows)
        return HandCandidates(self.palm[rows], self.hand[rows], self.touches[rows], tips, contacts)

    def duplicates(self, reference: HandCandidates, parameters: TouchParameters) -> Bools:
        """Return (k, n) True where a candidate is close to one of n reference candidates.

        Candidates are close if their touching fingers are equal, and palm and fingertips differ by
        less than the minimum separation and rotation of distinct grasps.
        """
        rotations, reference_rotations = (
            hands.palm[:, :3, :3].reshape(-1, 9) for hands in (self, reference)
        )
        is_duplicate = rotations @ reference_rotations.T > 1 + 2 * np.cos(parameters.min_rotation)
        is_duplicate &= (self.touches[:, None] == reference.touches).all(axis=2)
        limit = parameters.min_separation
        is_duplicate &= _distances(self.palm[:, :3, 3], reference.palm[:, :3, 3]) < limit
        for finger in range(self.touches.shape[1]):
            is_close = _distances(self.tips[:, finger], reference.tips[:, finger]) < limit
            is_duplicate &= is_close | ~self.touches[:, finger, None]
        return is_duplicate

    def new_rows(self, reference: HandCandidates, parameters: TouchParameters) -> NDArray[np.intp]:
        """Return the rows of candidates that duplicate no reference candidate."""
        return np.flatnonzero(~self.duplicates(reference, parameters).any(axis=1))

    def distinct_rows(self, parameters: TouchParameters, block: int = 256) -> NDArray[np.intp]:
        """Return the rows of candidates that do not duplicate an earlier one.

        Args:
            parameters: Thresholds of a duplicate.
            block: Number of candidates that are compared pairwise at once.
        """
        remaining, distinct = np.arange(len(self)), np.zeros(0, dtype=np.intp)
        while len(remaining):
            rows, remaining = remaining[:block], remaining[block:]
            is_duplicate = self.rows(rows).duplicates(self.rows(rows), parameters)
            is_first = np.ones(len(rows), dtype=bool)
            for i in range(len(rows)):
                is_first[i + 1 :] &= ~(is_first[i] & is_duplicate[i, i + 1 :])
            distinct = np.append(distinct, rows[is_first])
            compared = self.rows(rows[is_first])
            remaining = remaining[self.rows(remaining).new_rows(compared, parameters)]
        return distinct


def _distances(points: Array, reference: Array) -> Array:
    """Return the distances (k, n) between points (k, 3) and reference points (n, 3)."""
    return np.sqrt(((points[:, None] - reference) ** 2).sum(axis=2))


def touch_library() -> Any:
    """Return the compiled drivers `touch`, `apart`, `loads` and `nearest`.

    Raises:
        UnsupportedError: There is no C compiler.
    """
    sources = (
        WIDE if machine_lanes() else "",
        "typedef double scalar;\ntypedef double real;\n",
        define({"STEP_IN": 0, "STEP_OUT": 0}),
        *(driver_text(name) for name in ("common", "touch", "loads", "nearest")),
    )
    text = "".join(sources)
    library = load_library("touch", lambda: text, "casadi_ik_touch", text)
    if library is None:
        raise UnsupportedError(
            "grasps_of: a C compiler is missing; expected one on the path (docs/install.md)"
        )
    return library
