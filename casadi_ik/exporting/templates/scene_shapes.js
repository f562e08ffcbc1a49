
export const links = Object.freeze([@LINK_NAMES@]);
export const capacity = @CAPACITY@;
export const Kind = Object.freeze({ NOTHING: -1, HALF_SPACE: 0, CAPSULE: 1, BOX: 2, CYLINDER: 3 });
// The robot's shapes, in the order of Solver.shapes.
export const shapes = @SHAPES_JSON@;
