/** Inverse kinematics of @ROBOT@: metres and radians, the robot's base frame. */

/** Names, in the order of all arrays. */
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
  /** A number was no longer finite. */
  readonly INVALID: -1;
  /** Not ended yet: call run again. */
  readonly RUNNING: 0;
  /** Every contact within tolerance, every motor and joint within its limits. */
  readonly SOLVED: 1;
  /** Nothing better was found; q is the best. */
  readonly STALLED: 2;
  /** The budget of iterations is used up. */
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
   * A solver with memory of its own.
   * @param source Bytes or a compiled module; without it @PREFIX@.wasm beside this module.
   */
  static load(source?: BufferSource | WebAssembly.Module): Promise<Solver>;
  /** When contacts count as reached; of one finger, or of all. */
  setTolerance(position: number, angle: number, finger?: number): void;
  /** A narrower range of a motor; from = to: it stays there. */
  setRange(motor: number, from: number, to: number): void;
  /**
   * Solves one target.
   * @param points Three numbers a finger; NaN frees it.
   * @param normals Outward pad normals, of any length; NaN frees one.
   * @param q0 Where the robot is, and then a solution near it is wanted; without it the robot is at
   * home, and one far from its limits is wanted.
   */
  solve(points: ArrayLike<number>, normals: ArrayLike<number>, q0?: ArrayLike<number>): Answer;
  /** Takes up a target, to be solved by run; returns a Status. */
  begin(points: ArrayLike<number>, normals: ArrayLike<number>, q0?: ArrayLike<number>): number;
  /** Goes on for at most so many iterations. */
  run(iterations: number): Answer;
  /** Where the fingertips are and which way they face. */
  contacts(q: ArrayLike<number>): { points: Float64Array; normals: Float64Array };
@PALM_DTS?@@SCENE_DTS?@@FOLLOW_DTS?@}
