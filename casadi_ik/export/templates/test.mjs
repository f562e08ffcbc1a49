// node test.mjs: solves the stored targets, compares the solutions bit for bit, and measures time.
import { readFile } from "node:fs/promises";
import { Solver, Status } from "./@PREFIX@.js";

const targets = JSON.parse(await readFile(new URL("./targets.json", import.meta.url), "utf8"));
const solver = await Solver.load();
const slicedSolver = await Solver.load();
@SCENE_TEST_SET?@
function differs(answer, target) {
@SCENE_TEST_FREED?@  return (
    answer.status !== target.status ||
    answer.iterations !== target.iterations ||
    answer.restarts !== target.restarts ||
@SCENE_TEST_SAME?@    @SCENE_TEST_OR?@target.q.some((value, i) => !Object.is(value, answer.q[i]))
  );
}

let wrong = 0;
for (const target of targets) {
  wrong += differs(solver.solve(target.points, target.normals, target.q0 ?? undefined), target);
  slicedSolver.begin(target.points, target.normals, target.q0 ?? undefined);
  let answer;
  do answer = slicedSolver.run(3);
  while (answer.status === Status.RUNNING);
  wrong += differs(answer, target);
}
const zeros = new Float64Array(targets[0].points.length);
const refused = solver.solve(zeros, zeros).status === Status.BAD_INPUT;

const solvable = targets.filter((target) => target.status === Status.SOLVED);
const times = [];
for (let i = 0; i < 20000; ++i) {
  const target = solvable[i % solvable.length];
  const start = performance.now();
  solver.solve(target.points, target.normals, target.q0 ?? undefined);
  times.push(1e3 * (performance.now() - start));
}
times.sort((a, b) => a - b);
const mean = times.reduce((sum, time) => sum + time, 0) / times.length;
console.log(
  JSON.stringify({ targets: targets.length, wrong, refused, mean, median: times[10000], unit: "us" }),
);
process.exit(wrong || !refused ? 1 : 0);
