"""Checks of what enters from outside: poses, frames of a tracker, units, times.

Every entrance (Python, command line, files, streams, adapters) uses these functions, so that each
rule exists once:

- `poses`: a matrix or quaternion that is nearly a rotation becomes the nearest rotation; anything
  else is an `InvalidPoseError`.
- `units`: numbers that are probably in other units cause an `InputWarning`.
- `keypoints`: frames of a tracker that has lost the hand are rejected, with a reason.
- `keypoint_orders`: keypoints in the order of another data set are converted.
- `times`: times that are not in seconds, and motions of too many cycles, are an `InputError`.
"""
