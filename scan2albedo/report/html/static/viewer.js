// A viewer of one face: its state, its controls, and when it holds a WebGL context.
const MOST_AWAKE = 4; // browsers drop the oldest of 8 to 16 contexts
const MODE_LABELS = {
  relit: "Relit", albedo: "Albedo", scanned: "As scanned", light: "Light alone", normals: "Normals",
};
const awake = new Set();
const viewers = new Map();

class FaceViewer {
  constructor(root) {
    this.root = root;
    this.stage = root.querySelector(".stage");
    this.message = root.querySelector(".stage-message");
    viewers.set(root.dataset.face, this);
    new IntersectionObserver((entries) => {
      this.seen = entries.at(-1).isIntersecting;
      if (this.seen) this.wake();
    }, { rootMargin: "100px" }).observe(this.stage);
    new ResizeObserver(() => this.request()).observe(this.stage);
    handlePointer(this.stage, this);
    handleKeys(this.stage, this);
  }

  async wake() {
    if (this.painter || this.waking) return this.waking;
    this.waking = this.#start().catch((error) => this.#fail(`The face cannot be drawn: ${error.message}`));
    await this.waking;
    this.waking = null;
    return undefined;
  }

  async #start() {
    this.face ??= readJson(this.root.dataset.face);
    if (!this.state) this.#makeControls();
    const canvas = element("canvas", { "aria-hidden": "true" });
    const topology = readJson(`topology-${this.face.topology}`);
    const painter = await FacePainter.of(canvas, this.face, topology);
    if (!painter) { this.#fail("This browser has no WebGL 2, so the face cannot be turned here; the overview below shows it."); return; }
    this.painter = painter;
    canvas.addEventListener("webglcontextlost", () => { if (this.painter === painter) this.sleep(); });
    this.stage.querySelector("canvas")?.remove();
    this.stage.prepend(canvas);
    this.message.hidden = true;
    awake.delete(this);
    awake.add(this);
    for (const other of awake) {
      if (awake.size <= MOST_AWAKE) break;
      if (other !== this && !other.seen) other.sleep();
    }
    this.draw();
  }

  sleep() {
    awake.delete(this);
    const { painter } = this;
    this.painter = null;
    painter?.release();
  }

  #fail(text) {
    this.message.textContent = text;
    this.message.hidden = false;
    this.root.classList.add("failed");
  }

  #makeControls() {
    const { face } = this;
    const scanned = LightControls.scanned(face), harmonic = Boolean(face.harmonics);
    const first = scanned.length || harmonic ? scanned
      : [{ azimuth: -35, elevation: 25, distance: null, intensity: LAMP_INTENSITY, on: true }];
    this.state = {
      mode: "relit", lights: first, harmonic, ambient: 1, exposure: 0, shadows: face.castsShadows,
      autoExposure: !(scanned.length || harmonic), assumed: true,
      view: { azimuth: 0, elevation: 0, zoom: 1 },
    };
    this.lights = new LightControls(face, this.state, () => { this.#light(); });
    this.ambient = slider("Ambient", { low: 0, high: 2, step: 0.05, value: 1, show: (v) => v.toFixed(2),
      input: (v) => { this.state.ambient = v; this.#light(); } });
    this.exposure = slider("Exposure", { low: -4, high: 4, step: 0.1, value: 0, show: (v) => `${v > 0 ? "+" : ""}${v.toFixed(1)} EV`,
      input: (v) => { this.state.exposure = v; this.request(); } });
    const shadows = element("input", { type: "checkbox", onchange: () => { this.state.shadows = shadows.checked; this.#light(); } });
    shadows.checked = this.state.shadows;
    this.auto = element("input", { type: "checkbox", onchange: () => { this.state.autoExposure = this.auto.checked; this.request(); } });
    this.soft = element("input", { type: "checkbox", onchange: () => { this.state.harmonic = this.soft.checked; this.#light(); } });
    const assumed = element("input", { type: "checkbox", onchange: () => { this.state.assumed = assumed.checked; this.#light(); } });
    assumed.checked = this.state.assumed;
    const what = [face.filled && "filled gaps", face.assumedGloss && "skin's usual gloss"].filter(Boolean).join(" and ");
    this.lights.root.append(this.ambient.row,
      ...(harmonic ? [element("label", { class: "check" }, this.soft, " soft light of the scan, in place of the ambient light")] : []),
      element("label", { class: "check" }, shadows, " cast shadows"),
      ...(what ? [element("label", { class: "check" }, assumed, ` assumed: ${what}`)] : []));
    this.root.querySelector(".controls").replaceChildren(this.#modeChoice(), this.lights.root,
      element("fieldset", {}, element("legend", {}, "Picture"), this.exposure.row,
        element("label", { class: "check" }, this.auto, " expose each light by itself"),
        element("div", { class: "buttons" },
          element("button", { type: "button", onclick: () => this.resetView() }, "Reset view"),
          element("button", { type: "button", title: "The subject's right", onclick: () => this.turnTo(-45) }, "Right side"),
          element("button", { type: "button", title: "The subject's left", onclick: () => this.turnTo(45) }, "Left side"))));
    this.#showState();
  }

  // Boxes and sliders whose values a preset changes.
  #showState() {
    this.ambient.set(this.state.ambient);
    this.auto.checked = this.state.autoExposure;
    this.soft.checked = this.state.harmonic;
  }

  #modeChoice() {
    const { face } = this, name = `mode-${this.root.dataset.face}`;
    const there = { relit: true, albedo: face.hasAlbedo, scanned: face.texture, light: true, normals: true };
    const choices = Object.keys(MODE_LABELS).filter((mode) => there[mode]).map((mode) => {
      const radio = element("input", { type: "radio", name, value: mode, onchange: () => this.setMode(mode) });
      radio.checked = mode === this.state.mode;
      const label = mode === "relit" && !face.hasAlbedo ? "Shape" : MODE_LABELS[mode];
      return element("label", {}, radio, element("span", {}, label));
    });
    this.radios = choices.map((label) => label.firstChild);
    return element("fieldset", { class: "modes" }, element("legend", {}, "Show"), ...choices);
  }

  // A change of light is shown at once, whatever was shown before.
  #light() {
    if (this.state.mode !== "relit" && this.state.mode !== "light") this.setMode("relit");
    this.#showState();
    this.request();
  }

  setMode(mode) {
    this.state.mode = mode;
    for (const radio of this.radios) radio.checked = radio.value === mode;
    this.request();
  }

  turn(azimuth, elevation) {
    if (!this.state) return;
    const { view } = this.state;
    view.azimuth = (view.azimuth + azimuth + 540) % 360 - 180;
    view.elevation = clamp(view.elevation + elevation, -85, 85);
    this.request();
  }

  turnTo(azimuth) { this.state.view.azimuth = azimuth; this.request(); }

  zoom(factor) {
    if (!this.state) return;
    this.state.view.zoom = clamp(this.state.view.zoom * factor, 0.5, 12);
    this.request();
  }

  moveLight(azimuth, elevation) { this.lights?.move(azimuth, elevation); }

  resetView() { if (this.state) { this.state.view = { azimuth: 0, elevation: 0, zoom: 1 }; this.request(); } }

  request() {
    if (!this.painter || this.requested) return;
    this.requested = requestAnimationFrame(() => { this.requested = 0; this.draw(); });
  }

  draw() {
    if (!this.painter) return;
    const { canvas } = this.painter.gl, sharp = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.stage.clientWidth * sharp)), height = Math.max(1, Math.round(this.stage.clientHeight * sharp));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    this.painter.draw(this.state);
  }

  // The picture of a state as RGBA bytes, lowest row first: for programs that check it.
  pixels(size, state = {}) {
    const { gl } = this.painter;
    Object.assign(gl.canvas, { width: size, height: size });
    this.painter.draw({ ...this.state, ...state });
    const bytes = new Uint8Array(4 * size * size);
    gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    this.draw();
    return bytes;
  }
}
