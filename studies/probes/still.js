new Promise(done => {
  const took = [], canvas = document.querySelector('canvas');
  const next = () => requestAnimationFrame(begun => setTimeout(() => {
    took.push(window.painted(canvas) - begun);
    took.length < 8 ? next() : done(took.slice(2)); }));
  DRAW; next(); })
