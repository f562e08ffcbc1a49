
export const links: readonly string[];
/** How many solids may stand about the robot. */
export const capacity: number;
export const Kind: {
  readonly NOTHING: -1;
  /** All below z = 0 of its pose. */
  readonly HALF_SPACE: 0;
  /** Along z; size: radius, length without the caps. */
  readonly CAPSULE: 1;
  /** Size: its edges. */
  readonly BOX: 2;
  /** Along z; size: radius, length. */
  readonly CYLINDER: 3;
};
/** The robot's shapes, in the order of Solver.shapes; what is not `shown` only helps to hold a solid. */
export const shapes: {
  readonly capsules: readonly { link: string; radius: number; shown: boolean }[];
  readonly solids: readonly { link: string; kind: "box" | "cylinder"; size: readonly number[] }[];
};
