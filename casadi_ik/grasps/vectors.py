"""The vectors of a contact beside point and normal, and what they have to be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.arrays import Array, Bools

MORE: Mapping[str, str] = {
    "tangent": "where the contact frame's second axis must point, across the normal",
    "line": "the contact may be anywhere on the line through the point in this direction",
    "plane": "the contact may be anywhere on the plane through the point with this normal",
}
"""What a contact may have beside point and normal, by name; arrays have an s at the end."""

ACROSS = 1e-6
"""Largest cosine between a tangent and its normal that counts as rounding."""


def fault(vectors: Mapping[str, Array]) -> str | None:
    """What is wrong with the vectors of one contact: the first line of it, or None.

    Args:
        vectors: By name; "point" [m] and unit vectors, absent if free.
    """
    for name in MORE:
        if name in vectors and "point" not in vectors:
            return f"{name}: found one without a point, expected both"
    if "line" in vectors and "plane" in vectors:
        return "line and plane: found both, expected one of them"
    if "tangent" not in vectors:
        return None
    if "normal" not in vectors:
        return "tangent: found one without a normal, expected both"
    cosine = float(vectors["tangent"] @ vectors["normal"])
    if not abs(cosine) <= ACROSS:
        degrees = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return (
            f"tangent: found {np.round(vectors['tangent'], 6).tolist()} at {degrees:.4g} deg to "
            "the normal, expected 90 deg"
        )
    return None


def faulty(vectors: Mapping[str, Array]) -> Bools:
    """Which contacts `fault` has something to say about, all at once.

    Args:
        vectors: (..., 3) by name, as there, of all contacts; NaN where free.
    """
    given = {name: ~np.isnan(array[..., 0]) for name, array in vectors.items()}
    bad = np.zeros_like(given["point"])
    for name in MORE:
        if name in given:
            bad |= given[name] & ~given["point"]
    if "line" in given and "plane" in given:
        bad |= given["line"] & given["plane"]
    if "tangent" in given:
        cosine = np.einsum("...i,...i->...", vectors["tangent"], vectors["normal"])
        bad |= given["tangent"] & ~(np.abs(cosine) <= ACROSS)
    return bad


def squared(tangent: Array, normal: Array) -> Array:
    """Tangents (..., 3) without what rounding left of them along the normals, unit."""
    across = tangent - normal * np.einsum("...i,...i->...", normal, tangent)[..., None]
    return across / np.sqrt(np.einsum("...i,...i->...", across, across))[..., None]
