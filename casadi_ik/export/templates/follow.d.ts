  /**
   * Begins to follow moving contacts, at rest at q0 (null: at home).
   * @param options Time from cycle to cycle [s], 0.01 unless said, and limits of the motors; without
   * them the description's, and from rest to the velocity limit in a quarter of a second.
   */
  followFrom(
    q0?: ArrayLike<number> | null,
    options?: { period?: number; velocity?: ArrayLike<number>; acceleration?: ArrayLike<number> },
  ): void;
  /**
   * One cycle: positions, velocities and accelerations stay within limits, whatever the targets do.
   * @param palm Rotation row by row, then the origin: counts as far as the contacts leave it free.
   */
  follow(
    points: ArrayLike<number>,
    normals: ArrayLike<number>,
    palm?: ArrayLike<number>,
  ): {
    /** A FollowStatus. */
    status: 0 | 1 | 2 | 3;
    q: Float64Array;
    velocity: Float64Array;
    positionError: Float64Array;
    angleError: Float64Array;
  };
