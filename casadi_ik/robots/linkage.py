"""Links held together by joints: what carries what, of files, parts and robots alike."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Protocol, TypeVar

from casadi_ik.errors import DescriptionError


class Linking(Protocol):
    """What hangs a link on another one."""

    @property
    def parent(self) -> str:
        """The link above."""
        ...

    @property
    def child(self) -> str:
        """The link below."""
        ...


class Moving(Linking, Protocol):
    """The same, of a type: "fixed" or one that moves."""

    @property
    def type(self) -> str:
        """The type."""
        ...


L = TypeVar("L", bound=Linking)
J = TypeVar("J", bound=Moving)
J_co = TypeVar("J_co", bound=Moving, covariant=True)


class Jointed(Protocol[J_co]):
    """Links held together by joints: a file's, a part's or a robot's."""

    @property
    def root(self) -> str:
        """The base link."""
        ...

    @property
    def joints(self) -> Sequence[J_co]:
        """The joints, parents before children."""
        ...


def parents_first(joints: Iterable[L], root: str) -> tuple[L, ...]:
    """The order of the file, moved only where a child stands before its parent.

    Joints that do not hang on the root are left out.
    """
    hung, waiting = {root}, list(joints)
    placed: list[L] = []
    while waiting:
        joint = next((one for one in waiting if one.parent in hung), None)
        if joint is None:
            break
        waiting.remove(joint)
        placed.append(joint)
        hung.add(joint.child)
    return tuple(placed)


def known(name: str, names: Collection[str], noun: str, where: str) -> str:
    """The name of a link or joint, if it is among some.

    Raises:
        DescriptionError: It is not; the message lists them.
    """
    if name not in names:
        raise DescriptionError(f"{where}: unknown {noun} {name!r}; known: {', '.join(names)}")
    return name


def links_of(tree: Jointed[Moving]) -> tuple[str, ...]:
    """All links, the root first."""
    return (tree.root, *(joint.child for joint in tree.joints))


def above(tree: Jointed[J], link: str, top: str | None = None) -> list[J]:
    """The joints down to a link, in order: from the root, or from a link above it."""
    by_child = {joint.child: joint for joint in tree.joints}
    found: list[J] = []
    while link != top and link in by_child:
        found.append(by_child[link])
        link = by_child[link].parent
    return found[::-1]


def below(tree: Jointed[J], link: str) -> list[J]:
    """All joints that a link carries, directly or not."""
    carried, found = {link}, []
    for joint in tree.joints:
        if joint.parent in carried:
            carried.add(joint.child)
            found.append(joint)
    return found


def rigid(tree: Jointed[Moving], link: str) -> list[str]:
    """A link and all that is fixed to it below."""
    found = [link]
    for joint in tree.joints:
        if joint.type == "fixed" and joint.parent in found:
            found.append(joint.child)
    return found


def moving_below(tree: Jointed[J], link: str) -> list[J]:
    """The first moving joints below a link, those behind fixed ones included."""
    carried = rigid(tree, link)
    return [one for one in tree.joints if one.type != "fixed" and one.parent in carried]


def depth(tree: Jointed[Moving], link: str) -> int:
    """The most moving joints in a row below a link."""
    return max((1 + depth(tree, one.child) for one in moving_below(tree, link)), default=0)


def ends(tree: Jointed[Moving], link: str) -> list[str]:
    """The links below a link that carry nothing."""
    parents = {joint.parent for joint in tree.joints}
    return [joint.child for joint in below(tree, link) if joint.child not in parents]


def rigid_bodies(tree: Jointed[Moving]) -> tuple[dict[str, str], set[frozenset[str]]]:
    """By link the link it is fixed to that moves, or the root; and which of these share a joint."""
    bodies, neighbours = {tree.root: tree.root}, set()
    for joint in tree.joints:
        parent = bodies[joint.parent]
        bodies[joint.child] = parent if joint.type == "fixed" else joint.child
        neighbours.add(frozenset((parent, bodies[joint.child])))
    return bodies, neighbours
