// Which variables and factors are selected: one by a click, several with shift.

export class Selection {
  constructor() {
    this.keys = new Set();
    this.factors = new Map(); // id → { id, kind, keys }
  }

  get size() { return this.keys.size + this.factors.size; }

  clear() {
    this.keys.clear();
    this.factors.clear();
  }

  variable(key, more) {
    if (!more) this.clear();
    if (!this.keys.delete(key)) this.keys.add(key);
  }

  factor(factor, more) {
    if (!more) this.clear();
    if (!this.factors.delete(factor.id)) this.factors.set(factor.id, factor);
  }
}
