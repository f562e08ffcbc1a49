"""Checks of input data: poses, numbers, units and times, frames of a tracker.

All interfaces (Python, command line, files, streams, adapters) use these functions, so that each
rule is implemented once:

- `poses`: a matrix or quaternion that is nearly a rotation becomes the nearest rotation; anything
  else is an `InvalidPoseError`.
- `numbers`: numbers that are probably in other units cause an `InputWarning`. Times that are not
  in seconds, and motions of too many cycles, are an `InputError`.
- `keypoints`: frames of a tracker that has lost the hand are rejected, with a reason. Keypoints in
  the order of another data set are converted.
"""
