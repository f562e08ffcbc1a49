// Inverse kinematics of @ROBOT@ from fingertip contacts: an ES module for browsers and node.
// Written by casadi-ik export; @PREFIX@.d.ts has the types.

export const fingers = Object.freeze([@FINGER_NAMES@]);
export const motors = Object.freeze([@MOTOR_NAMES@]);
export const lower = Object.freeze(@LOWER_JSON@);
export const upper = Object.freeze(@UPPER_JSON@);
export const home = Object.freeze(@HOME_JSON@);
@SCENE_SHAPES_JS?@
export const Status = Object.freeze({
  BAD_INPUT: -2,
  INVALID: -1,
  RUNNING: 0,
  SOLVED: 1,
  STALLED: 2,
  ITERATION_LIMIT: 3,
@SCENE_STATUS_JS?@});
@FOLLOW_STATUS_JS?@
async function compiled(source) {
  if (source instanceof WebAssembly.Module) return source;
  if (source === undefined) {
    const place = new URL("./@PREFIX@.wasm", import.meta.url);
    if (place.protocol === "file:") {
      const { readFile } = await import("node:fs/promises");
      source = await readFile(place);
    } else {
      const answer = await fetch(place);
      if (!answer.ok) throw new Error(`${place}: ${answer.status} ${answer.statusText}`);
      source = await answer.arrayBuffer();
    }
  }
  return WebAssembly.compile(source);
}

function filled(target, values, name) {
  if (values.length !== target.length) {
    throw new RangeError(`${name}: found ${values.length} numbers, expected ${target.length}`);
  }
  target.set(values);
}

export class Solver {
  // A solver with memory of its own. `source`: bytes or a compiled module; without it the file
  // beside this one.
  static async load(source) {
    return new Solver(await WebAssembly.instantiate(await compiled(source), {}));
  }

  constructor(instance) {
    const wasm = (this._wasm = instance.exports);
    wasm._initialize?.();
    wasm.init();
    const view = (at, count) => new Float64Array(wasm.memory.buffer, at, count);
    this._points = view(wasm.points_at(), 3 * fingers.length);
    this._normals = view(wasm.normals_at(), 3 * fingers.length);
    this._q0 = view(wasm.q0_at(), motors.length);
    this._palm = view(wasm.palm_at(), 12);
    this._posture = view(wasm.posture_at(), motors.length);
    this._q = view(wasm.q_at(), motors.length);
    this._positionError = view(wasm.position_error_at(), fingers.length);
    this._angleError = view(wasm.angle_error_at(), fingers.length);
  }

  setTolerance(position, angle, finger = -1) {
    this._wasm.set_tolerance(finger, position, angle);
  }

  setRange(motor, from, to) {
    if (!(motor >= 0 && motor < motors.length)) throw new RangeError(`motor: found ${motor}`);
    this._wasm.set_range(motor, from, to);
  }

  solve(points, normals, q0) {
    this._ask(points, normals, q0);
    return this._answer(this._wasm.solve(q0 ? 1 : 0));
  }

  begin(points, normals, q0) {
    this._ask(points, normals, q0);
    return this._wasm.begin(q0 ? 1 : 0);
  }

  run(iterations) {
    return this._answer(this._wasm.run(iterations));
  }

  contacts(q) {
    filled(this._q0, q, "q");
    this._wasm.contacts();
    return { points: this._points.slice(), normals: this._normals.slice() };
  }
@PALM_JS?@@SCENE_JS?@@FOLLOW_JS?@
  _ask(points, normals, q0) {
    filled(this._points, points, "points");
    filled(this._normals, normals, "normals");
    if (q0) filled(this._q0, q0, "q0");
  }

  _answer(status) {
    return {
      status,
      q: this._q.slice(),
      positionError: this._positionError.slice(),
      angleError: this._angleError.slice(),
      iterations: this._wasm.iterations(),
      restarts: this._wasm.restarts(),
@SCENE_ANSWER_JS?@    };
  }
}
