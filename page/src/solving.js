// Questions to a robot's solver, and how long it takes.

// Clocks of browsers tick in tenths of a millisecond: to tell what a solve takes, the same target is
// solved for so long [ms].
const LONG = 25;

// What stands for a point or a normal that is free.
export const FREE = [NaN, NaN, NaN];

export class Solving {
  constructor(robot, solver) {
    Object.assign(this, { robot, solver });
    this.warm();
  }

  // Browsers compile twice, the second time what has been used: used it is here, not in a drag.
  warm() {
    const { solver, robot } = this, end = performance.now() + 150;
    const grasp = robot.about.grasps[0];
    const [points, normals] = [grasp.points, grasp.normals].map((all) => all.flatMap((v) => v ?? FREE));
    while (performance.now() < end) {
      solver.solve(points, normals);
      solver.solve(points, normals, robot.home);
    }
  }

  static async of(loaded) {
    const { about, solver: module, wasm } = loaded;
    const solver = await module.Solver.load(wasm);
    return new Solving({ ...module, about }, solver);
  }

  // Points and normals as lists of three numbers; solids as { kind, size, pose, grasped }.
  ask(points, normals, near, solids) {
    const { solver, robot } = this;
    for (let i = 0; i < robot.capacity; ++i) {
      const one = solids[i];
      if (one) solver.setSolid(i, one.kind, one.size, one.pose, one.grasped);
      else solver.setSolid(i, robot.Kind.NOTHING);
    }
    const begun = performance.now();
    const answer = this.tried(points.flat(), normals.flat(), near);
    return { ...answer, time: 1e3 * (performance.now() - begun), counted: 1 };
  }

  // Where the nearest answer touches something, the one that is far from limits may not; and the
  // other way round, from home.
  tried(points, normals, near) {
    const { solver, robot } = this, { COLLISION } = robot.Status;
    const first = solver.solve(points, normals, near ?? undefined);
    if (first.status !== COLLISION) return first;
    const second = solver.solve(points, normals, near ? undefined : robot.home);
    return second.status === COLLISION ? first : second;
  }

  // Time [us] of solving the same target again and again: the median over lots.
  timed(points, normals, near) {
    const flat = [points.flat(), normals.flat(), near];
    const end = performance.now() + LONG, lots = [];
    let counted = 0;
    do {
      const begun = performance.now();
      let count = 0;
      do {
        for (let i = 0; i < 4; ++i) this.tried(...flat);
        count += 4;
      } while (performance.now() - begun < 1);
      lots.push((1e3 * (performance.now() - begun)) / count);
      counted += count;
    } while (performance.now() < end);
    return { time: lots.sort((a, b) => a - b)[lots.length >> 1], counted };
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
