/** Inverse kinematics of @ROBOT@: metres and radians, in the base frame of the robot. */

/** Names of fingers and motors, in the order of all arrays. */
export const fingers: readonly string[];
export const motors: readonly string[];
/** Limits and home position of the motors. */
export const lower: readonly number[];
export const upper: readonly number[];
export const home: readonly number[];
@SCENE{@

export const links: readonly string[];
/** Maximum number of solids in the scene. */
export const capacity: number;
export const Kind: {
  readonly NOTHING: -1;
@KINDS_DTS@
};
/** Shapes of the robot, in the order of Solver.shapes; capsules that are not `shown` cover a solid. */
export const shapes: {
  readonly capsules: readonly { link: string; radius: number; shown: boolean }[];
  readonly solids: readonly { link: string; kind: "box" | "cylinder"; size: readonly number[] }[];
};
@}@

export const Status: {
  /** The target or q0 is malformed; nothing was solved. */
  readonly BAD_INPUT: -2;
  /** A number became infinite or NaN. */
  readonly INVALID: -1;
  /** Unfinished: call run again. */
  readonly RUNNING: 0;
  /** All contacts are within tolerance, all motors and joints within limits. */
  readonly SOLVED: 1;
  /** The search found no solution; q is the best configuration. */
  readonly STALLED: 2;
  /** The budget of iterations is exhausted. */
  readonly ITERATION_LIMIT: 3;
@SCENE_STATUS_DTS?@};
@FOLLOW_STATUS_DTS?@
export interface Answer {
  status: -2 | -1 | 0 | 1 | 2 | 3@SCENE_STATUS_TYPE?@;
  q: Float64Array;
  positionError: Float64Array;
  angleError: Float64Array;
  iterations: number;
  restarts: number;
@SCENE_ANSWER_DTS?@}

export class Solver {
  /**
   * Returns a solver with its memory.
   * @param source Bytes or a compiled module (default: @PREFIX@.wasm in the folder of this module).
   */
  static load(source?: BufferSource | WebAssembly.Module): Promise<Solver>;
  /** Sets the tolerances [m, rad] of the contact of a finger (default: of all fingers). */
  setTolerance(position: number, angle: number, finger?: number): void;
  /** Narrows the range of a motor; with from = to the motor is fixed. */
  setRange(motor: number, from: number, to: number): void;
  /**
   * Solves one target.
   * @param points Three numbers per finger; NaN marks a free finger.
   * @param normals Outward pad normals, of any length; NaN marks a free normal.
   * @param q0 Configuration of the robot; solutions near it are preferred. Without it the robot is at
   * home, and solutions far from its limits are preferred.
   */
  solve(points: ArrayLike<number>, normals: ArrayLike<number>, q0?: ArrayLike<number>): Answer;
  /** Starts the search for a target, which run continues; returns a Status. */
  begin(points: ArrayLike<number>, normals: ArrayLike<number>, q0?: ArrayLike<number>): number;
  /** Continues the search for at most this number of iterations. */
  run(iterations: number): Answer;
  /** Returns the contact points and outward normals of the fingertips. */
  contacts(q: ArrayLike<number>): { points: Float64Array; normals: Float64Array };
@PALM{@
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
@}@
@SCENE{@
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
@}@
@FOLLOW{@
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
  /** Opens the clutch: the motors decelerate to rest, and targets are ignored. */
  pause(): void;
  /**
   * Closes the clutch: the robot moves as the targets move from now on.
   * @param q Measured positions of the motors at rest; they may be beyond their limits. Omitted: the
   * commanded ones.
   */
  resume(q?: ArrayLike<number> | null): void;
  /** Sets the posture to which free motions lead, such as one with a preferred elbow. */
  followPosture(q: ArrayLike<number>): void;
@}@
}
