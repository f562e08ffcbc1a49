
  followFrom(q0, { period = 0.01, velocity, acceleration } = {}) {
    const wasm = this._wasm, count = motors.length;
    const rates = new Float64Array(wasm.memory.buffer, wasm.rates_at(), 2 * count);
    if (q0) filled(this._q0, q0, "q0");
    if (velocity) filled(rates.subarray(0, count), velocity, "velocity");
    if (acceleration) filled(rates.subarray(count), acceleration, "acceleration");
    if (wasm.follow_from(q0 ? 1 : 0, period, velocity ? 1 : 0, acceleration ? 1 : 0)) {
      throw new RangeError("followFrom: expected finite numbers, and period, velocity, acceleration > 0");
    }
  }

  follow(points, normals, palm) {
    const wasm = this._wasm, n = motors.length, f = fingers.length;
    this._ask(points, normals);
    if (palm) filled(this._palm, palm, "palm");
    const status = wasm.follow(palm ? 1 : 0);
    const results = new Float64Array(wasm.memory.buffer, wasm.followed_at(), 2 * (n + f));
    return {
      status,
      q: results.slice(0, n),
      velocity: results.slice(n, 2 * n),
      positionError: results.slice(2 * n, 2 * n + f),
      angleError: results.slice(2 * n + f),
    };
  }
