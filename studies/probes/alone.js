(() => {
  const { stage, now } = casadiIk, render = stage.renderer.render, { solving } = now;
  const tried = solving.tried;
  solving.tried = function (...given) {
    const asked = performance.now(), answer = tried.apply(this, given);
    if (window.row) Object.assign(window.row, {asked, solved: performance.now()});
    return answer;
  };
  stage.renderer.render = function (...given) {
    const row = window.row;
    window.row = null;
    if (row) row.placed = performance.now();
    render.apply(this, given);
    if (!row?.solved) return;
    row.submitted = performance.now();
    row.drawn = window.painted(this.domElement);
    window.rows.push(row);
  };
})()
