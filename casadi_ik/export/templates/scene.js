
  setSolid(number, kind, size, pose, grasped = false) {
    if (kind !== -1) {
      const wasm = this._wasm;
      const write = (address, values) =>
        new Float64Array(wasm.memory.buffer, address, values.length).set(values);
      if (pose.length !== 12) throw new RangeError(`pose: found ${pose.length} numbers, expected 12`);
      write(wasm.size_at(), Array.from({ length: 3 }, (_, i) => size[i] ?? 0));
      write(wasm.pose_at(), pose);
    }
    if (this._wasm.set_solid(number, kind, grasped ? 1 : 0)) {
      throw new RangeError(`solid ${number} of kind ${kind} is invalid; expected a number from 0 to ${capacity - 1} and a Kind`);
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
    if (!Number.isFinite(this._wasm.last_clearance())) return null;
    const name = (index) => (index < 0 ? `solid ${-1 - index}` : links[index]);
    return [name(this._wasm.closest(0)), name(this._wasm.closest(1))];
  }

  shapes(q) {
    filled(this._q0, q, "q");
    this._wasm.shapes();
    return new Float64Array(this._wasm.memory.buffer, this._wasm.places_at(), @SHAPE_POSES@).slice();
  }
