  /**
   * Returns the contacts of a hand posture at a palm pose, as a target of solve and begin.
   * @param palm Rotation row by row, then the origin.
   * @param posture One number per motor; those of the arm are ignored.
   */
  touched(
    palm: ArrayLike<number>,
    posture: ArrayLike<number>,
  ): { points: Float64Array; normals: Float64Array };
  /** Solves for the arm at a palm pose with a hand posture. */
  solvePalm(
    palm: ArrayLike<number>,
    posture: ArrayLike<number>,
    q0?: ArrayLike<number>,
  ): Answer;
