// Drawing: whatever changes the state asks for a frame, and there is one drawing per frame, however
// much has changed.

let draw = () => {};
let isDirty = false;

/** Says what draws. It gets the frame's time. */
export function drawWith(painter) {
  draw = painter;
}

/** Changes the state and asks for a frame. */
export function change(act = () => {}) {
  act();
  if (!isDirty) requestAnimationFrame(paint);
  isDirty = true;
}

function paint(frame) {
  isDirty = false;
  draw(frame);
}
