/** Inverse kinematics of @ROBOT@: metres and radians, in the base frame of the robot. */

/** Names of fingers and motors, in the order of all arrays. */
export const fingers: readonly string[];
export const motors: readonly string[];
/** Limits and home position of the motors. */
export const lower: readonly number[];
export const upper: readonly number[];
export const home: readonly number[];
@SCENE_SHAPES_DTS?@
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
@PALM_DTS?@@SCENE_DTS?@@FOLLOW_DTS?@}
