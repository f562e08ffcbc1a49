
export const links: readonly string[];
/** How many solids may stand about the robot. */
export const capacity: number;
export const Kind: {
  readonly NOTHING: -1;
@KINDS_DTS@
};
/** The robot's shapes, in the order of Solver.shapes; what is not `shown` only helps to hold a solid. */
export const shapes: {
  readonly capsules: readonly { link: string; radius: number; shown: boolean }[];
  readonly solids: readonly { link: string; kind: "box" | "cylinder"; size: readonly number[] }[];
};
