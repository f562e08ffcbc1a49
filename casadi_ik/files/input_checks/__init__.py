"""Checks of what enters from outside: poses, frames of a tracker, units, times.

Every entrance (Python, command line, files, streams, adapters) uses these functions, so that each
rule exists once:

- `poses`: a matrix or quaternion that is nearly a rotation becomes the nearest rotation; anything
  else is an `InputError`.
- `units`: numbers that are probably in other units cause an `InputWarning`.
- `keypoints`: frames of a hand that a tracker has lost are recognised; other orders of keypoints
  are converted.
- `times`: times that are not in seconds, and motions of too many cycles, are an `InputError`.
"""
