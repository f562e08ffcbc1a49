// Calls of a robot's solver, and their timing.

// Duration of a time measurement [ms]; clocks of browsers have a resolution of 0.1 ms.
const MEASURE_MS = 25;

// Value of a free point or normal.
export const FREE = [NaN, NaN, NaN];

export class TargetSolver {
  constructor(robot, solver) {
    Object.assign(this, { robot, solver });
    this.warmUp();
  }

  // Triggers the browser's optimising compiler before the first drag.
  warmUp() {
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
    return new TargetSolver({ ...module, about }, solver);
  }

  // Points and normals as lists of three numbers; solids as { kind, size, pose, grasped }.
  solve(points, normals, q0, solids) {
    const { solver, robot } = this;
    for (let i = 0; i < robot.capacity; ++i) {
      const solid = solids[i];
      if (solid) solver.setSolid(i, solid.kind, solid.size, solid.pose, solid.grasped);
      else solver.setSolid(i, robot.Kind.NOTHING);
    }
    const start = performance.now();
    const answer = this.solveOrRetry(points.flat(), normals.flat(), q0);
    return { ...answer, time: 1e3 * (performance.now() - start), solveCount: 1 };
  }

  // If the solution nearest to q0 collides, tries the one far from limits; without q0, tries home.
  solveOrRetry(points, normals, q0) {
    const { solver, robot } = this, { COLLISION } = robot.Status;
    const first = solver.solve(points, normals, q0 ?? undefined);
    if (first.status !== COLLISION) return first;
    const second = solver.solve(points, normals, q0 ? undefined : robot.home);
    return second.status === COLLISION ? first : second;
  }

  // Returns the time of a solve [us], the median over groups of solves of the same target.
  measureTime(points, normals, q0) {
    const flat = [points.flat(), normals.flat(), q0];
    const end = performance.now() + MEASURE_MS, times = [];
    let solveCount = 0;
    do {
      const start = performance.now();
      let count = 0;
      do {
        for (let i = 0; i < 4; ++i) this.solveOrRetry(...flat);
        count += 4;
      } while (performance.now() - start < 1);
      times.push((1e3 * (performance.now() - start)) / count);
      solveCount += count;
    } while (performance.now() < end);
    return { time: times.sort((a, b) => a - b)[times.length >> 1], solveCount };
  }

  // Returns the motors at a limit.
  motorsAtLimits(q) {
    const { lower, upper, motors } = this.robot;
    return motors.filter((_, i) => {
      const range = upper[i] - lower[i];
      return Math.min(q[i] - lower[i], upper[i] - q[i]) < 1e-3 * range;
    });
  }
}
