
  touched(palm, posture) {
    this._askPalm(palm, posture);
    if (this._wasm.touched()) throw new RangeError("touched: no rigid palm, or a motor beyond its limits");
    return { points: this._points.slice(), normals: this._normals.slice() };
  }

  solvePalm(palm, posture, q0) {
    this._askPalm(palm, posture);
    if (q0) filled(this._q0, q0, "q0");
    return this._answer(this._wasm.solve_palm(q0 ? 1 : 0));
  }

  _askPalm(palm, posture) {
    filled(this._palm, palm, "palm");
    filled(this._posture, posture, "posture");
  }
