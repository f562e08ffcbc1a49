
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
