// Inverse kinematics of @ROBOT@ from fingertip contacts: an ES module for browsers and node.
// Written by casadi-ik export; @PREFIX@.d.ts has the types.

export const fingers = Object.freeze([@FINGER_NAMES@]);
export const motors = Object.freeze([@MOTOR_NAMES@]);
export const lower = Object.freeze(@LOWER_JSON@);
export const upper = Object.freeze(@UPPER_JSON@);
export const home = Object.freeze(@HOME_JSON@);
@SCENE{@

export const links = Object.freeze([@LINK_NAMES@]);
export const capacity = @CAPACITY@;
export const Kind = Object.freeze({ NOTHING: -1, @KINDS_JS@ });
// The robot's shapes, in the order of Solver.shapes.
export const shapes = @SHAPES_JSON@;
@}@

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
@PALM{@

  touched(palm, posture) {
    this._setPalm(palm, posture);
    if (this._wasm.palm_contacts()) throw new RangeError("touched: the palm pose is not rigid, or a motor exceeds its limits");
    return { points: this._points.slice(), normals: this._normals.slice() };
  }

  solvePalm(palm, posture, q0) {
    this._setPalm(palm, posture);
    if (q0) filled(this._q0, q0, "q0");
    return this._answer(this._wasm.solve_palm(q0 ? 1 : 0));
  }

  _setPalm(palm, posture) {
    filled(this._palm, palm, "palm");
    filled(this._posture, posture, "posture");
  }
@}@
@SCENE{@

  setSolid(number, kind, size, pose, grasped = false) {
    if (kind !== -1) {
      const wasm = this._wasm;
      const write = (address, values) =>
        new Float64Array(wasm.memory.buffer, address, values.length).set(values);
      if (pose.length !== 12) throw new RangeError(`pose: found ${pose.length} numbers, expected 12`);
      write(wasm.size_at(), Array.from({ length: 3 }, (_, i) => size[i] ?? 0));
      write(wasm.pose_at(), pose);
    }
    if (this._wasm.set_solid(number, kind, grasped ? 1 : 0)) {
      throw new RangeError(`solid ${number} of kind ${kind} is invalid; expected a number from 0 to ${capacity - 1} and a Kind`);
    }
  }

  setMargin(margin) {
    this._wasm.set_margin(margin);
  }

  clearance(q) {
    filled(this._q0, q, "q");
    const clearance = this._wasm.clearance();
    return { clearance, closest: this.closest() };
  }

  closest() {
    if (!Number.isFinite(this._wasm.last_clearance())) return null;
    const name = (index) => (index < 0 ? `solid ${-1 - index}` : links[index]);
    return [name(this._wasm.closest(0)), name(this._wasm.closest(1))];
  }

  shapes(q) {
    filled(this._q0, q, "q");
    this._wasm.shapes();
    return new Float64Array(this._wasm.memory.buffer, this._wasm.places_at(), @SHAPE_POSES@).slice();
  }
@}@
@FOLLOW{@

  followFrom(q0, { period = 0.01, velocity, acceleration } = {}) {
    const wasm = this._wasm, count = motors.length;
    const rates = new Float64Array(wasm.memory.buffer, wasm.rates_at(), 2 * count);
    if (q0) filled(this._q0, q0, "q0");
    if (velocity) filled(rates.subarray(0, count), velocity, "velocity");
    if (acceleration) filled(rates.subarray(count), acceleration, "acceleration");
    if (wasm.follow_from(q0 ? 1 : 0, period, velocity ? 1 : 0, acceleration ? 1 : 0)) {
      throw new RangeError("followFrom: expected finite numbers, and period, velocity, acceleration > 0");
    }
  }

  follow(points, normals, palm) {
    const wasm = this._wasm, n = motors.length, f = fingers.length;
    this._ask(points, normals);
    if (palm) filled(this._palm, palm, "palm");
    const status = wasm.follow(palm ? 1 : 0);
    const results = new Float64Array(wasm.memory.buffer, wasm.followed_at(), 2 * (n + f));
    return {
      status,
      q: results.slice(0, n),
      velocity: results.slice(n, 2 * n),
      positionError: results.slice(2 * n, 2 * n + f),
      angleError: results.slice(2 * n + f),
    };
  }

  pause() { this._wasm.pause(); }

  resume(q) {
    if (q) filled(this._q0, q, "q");
    if (this._wasm.resume(q ? 1 : 0)) throw new RangeError("resume: expected finite numbers");
  }

  followPosture(q) {
    filled(this._q0, q, "q");
    if (this._wasm.follow_posture()) throw new RangeError("followPosture: expected finite numbers");
  }
@}@

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
