// Owns the parts that views share: frames, dialogs, notifications, lists, states, texts and
// addresses; it never sends a request and never knows a view.
//
// This module is the frames: every change of state requests one, and each is drawn once.

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
