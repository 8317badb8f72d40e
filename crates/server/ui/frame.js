// Drawing: every change of state requests a frame, and each frame is drawn once.

let draw = () => {};
let isDirty = false;

/** Sets the render function. It gets the timestamp of the frame. */
export function setRenderer(painter) {
  draw = painter;
}

/** Changes state and requests a frame. */
export function change(act = () => {}) {
  act();
  if (!isDirty) requestAnimationFrame(paint);
  isDirty = true;
}

function paint(frame) {
  isDirty = false;
  draw(frame);
}
