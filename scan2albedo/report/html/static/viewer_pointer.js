// Turning, zooming and lighting by pointer, touch, wheel and keys.
const WHEEL_PAUSE_MS = 400;
let lastScroll = 0;
addEventListener("scroll", () => { lastScroll = performance.now(); }, { passive: true });

function handlePointer(stage, viewer) {
  const fingers = new Map();
  let spread = 0;
  stage.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    stage.setPointerCapture(event.pointerId);
    spread = 0;
  });
  stage.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (spread) viewer.zoom(now / spread);
      spread = now;
      return;
    }
    const degrees = 180 / Math.max(stage.clientWidth, 1);
    const right = (event.clientX - before[0]) * degrees, down = (event.clientY - before[1]) * degrees;
    if (event.shiftKey) viewer.moveLight(right, -down);
    else viewer.turn(-right, down);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    stage.addEventListener(name, (event) => { fingers.delete(event.pointerId); spread = 0; });
  }
  stage.addEventListener("dblclick", () => viewer.resetView());
  stage.addEventListener("wheel", (event) => {
    // A page that is being scrolled past the face goes on scrolling.
    if (!event.ctrlKey && performance.now() - lastScroll < WHEEL_PAUSE_MS) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    viewer.zoom(Math.exp(-clamp(event.deltaY * lines, -200, 200) * 0.0015));
  }, { passive: false });
}

function handleKeys(stage, viewer) {
  const arrows = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] };
  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = arrows[event.key];
    if (step && event.shiftKey) viewer.moveLight(...step);
    else if (step) viewer.turn(step[0], step[1]);
    else if (event.key === "+" || event.key === "=") viewer.zoom(1.15);
    else if (event.key === "-") viewer.zoom(1 / 1.15);
    else if (event.key === "0" || event.key === "Home") viewer.resetView();
    else return;
    event.preventDefault();
  });
}
