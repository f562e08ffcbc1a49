"""What is put into a page before its own scripts, to know when what happened.

Every answer to a pointer's event becomes a row of times in `window.rows` [ms, the page's clock].
A page that a server solves for: `event` (the browser has it), `sent` (handed to the socket),
`came` (the answer is there), `told` (the verdict is on the page), `drawn` (the frame that shows it
is painted by the graphics library: a pixel is read back, which waits for all of it). One that
solves by itself: `event`, `asked` (the solve begins), `solved`, `placed` (what is drawn stands
where it belongs), `submitted` (drawing calls are made), `drawn`.
"""

from __future__ import annotations

COMMON = """
window.rows = []; window.row = null;
addEventListener('pointermove', e => { window.row = {event: e.timeStamp}; }, true);
window.painted = canvas => {
  const gl = canvas.getContext('webgl2');
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now();
};
"""

SERVED = (
    COMMON
    + """
const verdict = m => m.type === 'GuiUpdateMessage' && /ik-status/.test(m.updates?.content ?? '');
const done = row => { if (row.told && row.painted) {
  row.drawn = Math.max(row.told, row.painted); window.rows.push(row); } };
window.messages = 0;
window.Worker = class extends Worker {
  constructor(...given) {
    super(...given);
    this.addEventListener('message', e => {
      if (e.data?.type !== 'message_batch') return;
      window.messages += e.data.messages.length;
      const row = window.row;
      if (!row?.sent || row.came || !e.data.messages.some(verdict)) return;
      row.came = performance.now();
      requestAnimationFrame(() => setTimeout(() => {
        row.painted = window.painted(document.querySelector('canvas'));
        done(row);
      }));
    });
  }
  postMessage(data, ...more) {
    const row = window.row;
    if (row && !row.sent && data?.message?.type === 'TransformControlsUpdateMessage')
      row.sent = performance.now();
    super.postMessage(data, ...more);
  }
};
const told = n => n.querySelector && n.querySelector('.ik-status') !== null;
new MutationObserver(records => {
  const row = window.row;
  if (!row?.came || row.told) return;
  if (!records.some(r => told(r.target) || [...r.addedNodes].some(told))) return;
  row.told = performance.now();
  done(row);
}).observe(document, {subtree: true, childList: true, characterData: true});
"""
)
"""For the page of `casadi-ik view`."""

ALONE = (
    COMMON
    + """
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
"""
)
"""For the page without a server, once it is there."""

NO_PAINTING = """
for (const kind of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced',
    'clear', 'clearBufferfv', 'clearBufferiv', 'clearBufferuiv', 'clearBufferfi',
    'blitFramebuffer'])
  WebGL2RenderingContext.prototype[kind] = () => {};
"""
"""Leaves out what a graphics card is for, clearing too: all that the page itself does remains.

A picture that is only cleared is put on the screen as well, in software too: 25 ms of a processor.
"""

STILL = """new Promise(done => {
  const took = [], canvas = document.querySelector('canvas');
  const next = () => requestAnimationFrame(begun => setTimeout(() => {
    took.push(window.painted(canvas) - begun);
    took.length < 8 ? next() : done(took.slice(2)); }));
  DRAW; next(); })"""
"""Times [ms] of painting one and the same picture again and again."""
