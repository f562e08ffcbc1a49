  /**
   * Starts to follow moving contacts, at rest at q0 (null: at home).
   * @param options Time from cycle to cycle [s] (default: 0.01), and limits of the motors. Defaults are
   * the velocities of the robot's description, and accelerations that reach them in 0.25 s.
   */
  followFrom(
    q0?: ArrayLike<number> | null,
    options?: { period?: number; velocity?: ArrayLike<number>; acceleration?: ArrayLike<number> },
  ): void;
  /**
   * Computes one cycle: positions, velocities and accelerations stay within limits for all targets.
   * @param palm Rotation row by row, then the origin; it counts as far as the contacts permit.
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
