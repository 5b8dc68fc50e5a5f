"use strict";
// The camera that all runs share, turned by mouse, fingers and buttons. `changed` is called after each change.

const VIEWS = { front: [0, 0.08], side: [Math.PI / 2, 0.08], top: [0, Math.PI / 2] };  // azimuth, elevation [radians]

class Orbit {
  constructor(run, changed) {
    Object.assign(this, { run, changed });
    this.home();
  }

  home() {
    const { azimuth, elevation } = this.run;
    Object.assign(this, { azimuth, elevation, zoom: 1, shift: [0, 0] });
    this.changed();
  }

  // See it from the front, the side or the top, at the zoom that there is.
  view(name) {
    [this.azimuth, this.elevation] = VIEWS[name];
    this.shift = [0, 0];
    this.changed();
  }

  turn(dx, dy) {
    this.azimuth -= 2.5 * dx;
    this.elevation = Math.min(Math.PI / 2, Math.max(0.02, this.elevation + 2.5 * dy));
  }

  // One finger or the mouse turns; two fingers, the right button or shift move; the wheel and two fingers zoom.
  listen(canvas) {
    const held = new Map();  // where each finger is
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const release = (event) => held.delete(event.pointerId);
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener("pointermove", (event) => {
      const old = held.get(event.pointerId), height = canvas.clientHeight;
      if (!old) return;
      const [dx, dy] = [(event.clientX - old[0]) / height, (event.clientY - old[1]) / height];
      const before = held.size > 1 ? apart() : 0;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      if (held.size > 1) this.zoom *= apart() / Math.max(before, 1);
      if (held.size > 1 || event.buttons === 2 || event.shiftKey) {
        this.shift = [this.shift[0] + dx / held.size, this.shift[1] + dy / held.size];
      } else this.turn(dx, dy);
      this.changed();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom *= Math.exp(-0.001 * event.deltaY);
      this.changed();
    }, { passive: false });
  }
}
