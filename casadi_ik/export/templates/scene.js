
  setSolid(number, kind, size, pose, grasped = false) {
    if (kind !== -1) {
      const wasm = this._wasm;
      const put = (at, values) => new Float64Array(wasm.memory.buffer, at, values.length).set(values);
      if (pose.length !== 12) throw new RangeError(`pose: found ${pose.length} numbers, expected 12`);
      put(wasm.size_at(), Array.from({ length: 3 }, (_, i) => size[i] ?? 0));
      put(wasm.pose_at(), pose);
    }
    if (this._wasm.set_solid(number, kind, grasped ? 1 : 0)) {
      throw new RangeError(`solid ${number} of kind ${kind}: expected 0 to ${capacity - 1}, a Kind`);
    }
  }

  setMargin(margin) {
    this._wasm.set_margin(margin);
  }

  clearance(q) {
    filled(this._q0, q, "q");
    const clearance = this._wasm.clearance();
    return { clearance, closest: this.closest() };
  }

  closest() {
    if (!Number.isFinite(this._wasm.least())) return null;
    const name = (at) => (at < 0 ? `solid ${-1 - at}` : links[at]);
    return [name(this._wasm.closest(0)), name(this._wasm.closest(1))];
  }

  shapes(q) {
    filled(this._q0, q, "q");
    this._wasm.shapes();
    return new Float64Array(this._wasm.memory.buffer, this._wasm.places_at(), @PLACED@).slice();
  }
