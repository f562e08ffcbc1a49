// Questions to a robot's solver, and how long it takes.
const LONG = 1.0;

// Clocks of browsers tick in tenths of a millisecond: the same target is solved as often as takes
// about LONG [ms], and the time of one is the mean.
export class Solving {
  constructor(robot, solver) {
    Object.assign(this, { robot, solver });
    this.count = 1;
    this.warm();
  }

  // Browsers compile twice, the second time what has been used: used it is here, not in a drag.
  warm() {
    const { solver, robot } = this, end = performance.now() + 150;
    const { points, normals } = robot.about.grasps[0];
    while (performance.now() < end) {
      solver.solve(points.flat(), normals.flat());
      solver.solve(points.flat(), normals.flat(), robot.home);
    }
  }

  static async of(loaded) {
    const { about, solver: module, wasm } = loaded;
    const solver = await module.Solver.load(wasm);
    return new Solving({ about, ...module }, solver);
  }

  // Points and normals as lists of three numbers; solids as { kind, size, pose, grasped }.
  ask(points, normals, near, solids) {
    const { solver, robot } = this;
    for (let i = 0; i < robot.capacity; ++i) {
      const one = solids[i];
      if (one) solver.setSolid(i, one.kind, one.size, one.pose, one.grasped);
      else solver.setSolid(i, robot.Kind.NOTHING);
    }
    const flat = [points.flat(), normals.flat(), near ?? undefined];
    const begun = performance.now();
    let answer;
    for (let i = 0; i < this.count; ++i) answer = solver.solve(...flat);
    const spent = performance.now() - begun;
    const time = (1e3 * spent) / this.count;
    answer = { ...answer, time, counted: this.count, spent };
    this.count = Math.max(1, Math.min(64, Math.round(spent > 0 ? (this.count * LONG) / spent : 64)));
    return answer;
  }

  // Motors that are at an end of their range.
  atEnds(q) {
    const { lower, upper, motors } = this.robot;
    return motors.filter((_, i) => {
      const range = upper[i] - lower[i];
      return Math.min(q[i] - lower[i], upper[i] - q[i]) < 1e-3 * range;
    });
  }
}
