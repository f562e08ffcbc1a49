for (const kind of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced',
    'clear', 'clearBufferfv', 'clearBufferiv', 'clearBufferuiv', 'clearBufferfi',
    'blitFramebuffer'])
  WebGL2RenderingContext.prototype[kind] = () => {};
