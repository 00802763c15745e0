// The pointer: moves, turns and zooms a view; it reports clicks and drags to its listeners.

const CLICK_PX = 4;

// clicked(x, y, event), and grab(x, y): null, or { to(x, y), dropped() } if something is taken hold of there.
export function hands(canvas, view, { redraw, clicked, grab = () => null }) {
  let from = null, moved = 0, held = null;
  canvas.onpointerdown = (e) => {
    from = [e.clientX, e.clientY];
    moved = 0;
    held = grab(e.offsetX, e.offsetY);
    canvas.setPointerCapture(e.pointerId);
  };
  canvas.onpointermove = (e) => {
    if (!from) return;
    const [dx, dy] = [e.clientX - from[0], e.clientY - from[1]];
    moved += Math.hypot(dx, dy);
    if (moved < CLICK_PX) return;
    from = [e.clientX, e.clientY];
    view.follow = false;
    if (held) held.to(e.offsetX, e.offsetY);
    else if (view.seen.plane === "orbit" && !e.ctrlKey && e.buttons !== 2) view.seen.turn(view.seen.yaw - dx * 0.4, view.seen.pitch + dy * 0.4);
    else view.seen.pan(dx, dy);
    redraw();
  };
  canvas.onpointerup = (e) => {
    const was = held;
    from = held = null;
    if (was && moved >= CLICK_PX) was.dropped();
    else if (moved < CLICK_PX && e.button === 0) clicked(e.offsetX, e.offsetY, e);
  };
  canvas.oncontextmenu = (e) => e.preventDefault();
  canvas.onwheel = (e) => {
    e.preventDefault();
    if (!view.seen.scale) return;
    view.follow = false;
    view.seen.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY);
    redraw();
  };
}
