
export const links = Object.freeze([@LINK_NAMES@]);
export const capacity = @CAPACITY@;
export const Kind = Object.freeze({ NOTHING: -1, @KINDS_JS@ });
// The robot's shapes, in the order of Solver.shapes.
export const shapes = @SHAPES_JSON@;
