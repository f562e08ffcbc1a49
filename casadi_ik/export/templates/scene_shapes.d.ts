
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
