  /**
   * Places a solid in the scene; Kind.NOTHING removes it. A target is solved only if the robot is
   * collision-free.
   * @param pose Rotation row by row, then the origin.
   * @param grasped True if links of fingertip pads with a contact may touch it.
   */
  setSolid(
    number: number,
    kind: number,
    size?: ArrayLike<number>,
    pose?: ArrayLike<number>,
    grasped?: boolean,
  ): void;
  /** Sets the required clearance [m]. */
  setMargin(margin: number): void;
  /** Returns the clearance of a configuration [m] and the nearest pair. */
  clearance(q: ArrayLike<number>): {
    clearance: number;
    closest: readonly [string, string] | null;
  };
  /** Returns shape poses: six numbers per capsule (middle of its segment, and the vector from there to
   * its end), then twelve per solid (rotation row by row, origin). */
  shapes(q: ArrayLike<number>): Float64Array;
