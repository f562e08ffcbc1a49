  /**
   * Puts a solid into the scene; Kind.NOTHING takes it out. Being solved includes that nothing
   * touches.
   * @param pose Rotation row by row, then the origin.
   * @param grasped Whether the links whose pads are in contact may touch it.
   */
  setSolid(
    number: number,
    kind: number,
    size?: ArrayLike<number>,
    pose?: ArrayLike<number>,
    grasped?: boolean,
  ): void;
  /** The distance to keep. */
  setMargin(margin: number): void;
  /** How far a configuration is from touching, and which two are nearest. */
  clearance(q: ArrayLike<number>): {
    clearance: number;
    closest: readonly [string, string] | null;
  };
  /** Six numbers a capsule (middle, half), then twelve a solid (rotation row by row, origin). */
  shapes(q: ArrayLike<number>): Float64Array;
