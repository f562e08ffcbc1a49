  /**
   * Where the fingertips are if the hand has a posture and its palm a pose: targets for solve and
   * others.
   * @param palm Rotation row by row, then the origin.
   * @param posture A number for each motor; those of the arm are not looked at.
   */
  touched(
    palm: ArrayLike<number>,
    posture: ArrayLike<number>,
  ): { points: Float64Array; normals: Float64Array };
  /** As solve, for a palm that is given with the posture of the hand: only the arm is unknown. */
  solvePalm(
    palm: ArrayLike<number>,
    posture: ArrayLike<number>,
    q0?: ArrayLike<number>,
  ): Answer;
