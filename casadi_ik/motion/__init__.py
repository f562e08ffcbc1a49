"""Motion: followers of moving targets, tracking of paths, retargeting, and reaching grasps."""

from casadi_ik.motion.approach import Approach, ReachStatus
from casadi_ik.motion.follower import Branch, Follower, FollowState, FollowStatus
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.reach import Reach
from casadi_ik.motion.retarget import Retargeter, load_retarget
from casadi_ik.motion.track import Jump, Track

__all__ = [
    "Approach",
    "Branch",
    "FollowState",
    "FollowStatus",
    "Follower",
    "Jump",
    "Motion",
    "Reach",
    "ReachStatus",
    "Retargeter",
    "Track",
    "load_retarget",
]
