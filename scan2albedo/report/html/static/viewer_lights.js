// The lights of a viewer: presets, one slider row a number, and a disc to drag them on. Left and right are the
// subject's everywhere; from the front the left is on the right of the picture, and so are its buttons.
const PRESETS = {
  Front: [{ azimuth: 0, elevation: 0 }],
  Right: [{ azimuth: -60, elevation: 10 }],
  Left: [{ azimuth: 60, elevation: 10 }],
  Above: [{ azimuth: 0, elevation: 65 }],
  Below: [{ azimuth: 0, elevation: -50 }],
};
const SCANNED = "As scanned";
const LAMP_INTENSITY = 2.5, MOST_DISTANCE = 3000;

class LightControls {
  constructor(face, state, changed) {
    this.face = face;
    this.state = state;
    this.changed = changed;
    this.chosen = 0;
    this.nearest = Math.ceil(face.reach * 1.05);
    this.preset = "";
    this.pad = this.#makePad();
    this.chips = element("div", { class: "chips", role: "group", "aria-label": "Lights" });
    this.sliders = this.#makeSliders();
    this.onBox = element("input", { type: "checkbox", onchange: () => { this.light.on = this.onBox.checked; this.#announce(); } });
    this.remove = element("button", { type: "button", onclick: () => this.#removeChosen() }, "Remove");
    this.detail = element("div", { class: "light-detail" },
      element("div", { class: "row" }, element("label", { class: "check" }, this.onBox, " on"), this.remove),
      ...Object.values(this.sliders).map((made) => made.row));
    this.presets = element("div", { class: "presets", role: "group", "aria-label": "Light presets" },
      ...this.#presetButtons());
    this.root = element("fieldset", { class: "lights" }, element("legend", {}, "Light"),
      this.presets, element("div", { class: "light-body" }, this.pad, element("div", {}, this.chips, this.detail)));
    this.refresh(face.lights.length || face.harmonics ? SCANNED : "");
  }

  get light() { return this.state.lights[this.chosen]; }

  static scanned(face) {
    return face.lights.map((light) => ({ ...light, on: true }));
  }

  #presetButtons() {
    const whose = (label) => label === "Left" || label === "Right" ? `From the subject's ${label.toLowerCase()}` : false;
    const button = (label, lights, harmonic = false) => element("button", {
      type: "button", "aria-pressed": "false", title: whose(label),
      onclick: () => { this.setLights(lights().map((light) => ({ ...light, on: true })), harmonic, label); },
    }, label);
    const buttons = Object.entries(PRESETS).map(([label, lights]) => button(label,
      () => lights.map((light) => ({ distance: null, intensity: LAMP_INTENSITY, ...light }))));
    if (!this.face.lights.length && !this.face.harmonics) return buttons;
    return [button(SCANNED, () => this.face.lights, Boolean(this.face.harmonics)), ...buttons];
  }

  setLights(lights, harmonic = false, preset = "") {
    this.state.lights = lights;
    this.state.harmonic = harmonic;
    this.state.ambient = 1;
    this.state.autoExposure = preset !== SCANNED;
    this.chosen = 0;
    this.#announce(preset);
  }

  // By degrees, for the pointer and the keyboard on the face.
  move(azimuth, elevation) {
    if (!this.light) return;
    this.light.azimuth = clamp(this.light.azimuth + azimuth, -180, 180);
    this.light.elevation = clamp(this.light.elevation + elevation, -90, 90);
    this.#announce();
  }

  #announce(preset = "") { this.refresh(preset); this.changed(); }

  #removeChosen() {
    this.state.lights.splice(this.chosen, 1);
    this.chosen = Math.max(0, this.chosen - 1);
    this.#announce();
  }

  #add() {
    const azimuth = this.light && this.light.azimuth > 0 ? -45 : 45;
    this.state.lights.push({ azimuth, elevation: 20, distance: null, intensity: LAMP_INTENSITY / 2, on: true });
    this.chosen = this.state.lights.length - 1;
    this.#announce();
  }

  #makeSliders() {
    const strongest = Math.max(6, ...this.face.lights.map((light) => Math.ceil(1.5 * light.intensity)));
    const set = (name) => (value) => { this.light[name] = value; this.#announce(); };
    const degrees = (value) => `${Math.round(value)}°`;
    // The slider is logarithmic; its end is a distant light.
    const far = (part) => part >= 1 ? null : this.nearest * (MOST_DISTANCE / this.nearest) ** part;
    this.partOf = (distance) => distance ? Math.log(distance / this.nearest) / Math.log(MOST_DISTANCE / this.nearest) : 1;
    return {
      azimuth: slider("Azimuth", { low: -180, high: 180, step: 1, value: 0, show: degrees, input: set("azimuth") }),
      elevation: slider("Elevation", { low: -90, high: 90, step: 1, value: 0, show: degrees, input: set("elevation") }),
      intensity: slider("Intensity", { low: 0, high: strongest, step: 0.05, value: 1, show: (v) => v.toFixed(2), input: set("intensity") }),
      distance: slider("Distance", {
        low: 0, high: 1, step: 0.01, value: 1, show: (v) => far(v) ? `${Math.round(far(v))} mm` : "distant",
        input: (v) => { this.light.distance = far(v); this.#announce(); },
      }),
    };
  }

  #makePad() {
    const pad = element("svg", { viewBox: "-60 -60 120 120", class: "pad", "aria-hidden": "true" },
      element("circle", { r: 50, class: "pad-ground" }), element("circle", { r: 25, class: "pad-line" }),
      element("line", { x1: -50, x2: 50, class: "pad-line" }), element("line", { y1: -50, y2: 50, class: "pad-line" }));
    this.dots = element("g");
    pad.append(this.dots);
    const drag = (event) => {
      const box = pad.getBoundingClientRect();
      let x = ((event.clientX - box.left) / box.width * 120 - 60) / 50, y = -((event.clientY - box.top) / box.height * 120 - 60) / 50;
      const length = Math.hypot(x, y);
      if (length > 0.999) { x *= 0.999 / length; y *= 0.999 / length; }
      this.light.elevation = Math.asin(y) / RADIANS;
      this.light.azimuth = Math.atan2(x, Math.sqrt(Math.max(1 - x * x - y * y, 0))) / RADIANS;
      this.#announce();
    };
    pad.addEventListener("pointerdown", (event) => {
      const index = Number(event.target.dataset.light);
      if (event.target.dataset.light) this.chosen = index;
      if (!this.light) return;
      pad.setPointerCapture(event.pointerId);
      if (!event.target.dataset.light) drag(event);
      this.refresh(this.preset);
    });
    pad.addEventListener("pointermove", (event) => { if (pad.hasPointerCapture(event.pointerId)) drag(event); });
    return pad;
  }

  // `preset` is the name of the one whose light it is, or "" for a light of the user's own.
  refresh(preset = "") {
    const { lights } = this.state;
    this.preset = preset;
    for (const button of this.presets.children) button.setAttribute("aria-pressed", String(button.textContent === preset));
    this.dots.replaceChildren(...lights.map((light, k) => {
      const [x, y, z] = directionOf(light.azimuth, light.elevation);
      const names = ["pad-dot", k === this.chosen ? "chosen" : "", z < 0 ? "behind" : "", light.on ? "" : "off"];
      return element("circle", { cx: 50 * x, cy: -50 * y, r: 7, class: names.join(" "), "data-light": String(k) });
    }));
    const chips = lights.map((light, k) => element("button", {
      type: "button", class: "chip", "aria-pressed": String(k === this.chosen),
      onclick: () => { this.chosen = k; this.refresh(this.preset); },
    }, `Light ${k + 1}${light.on ? "" : " (off)"}`));
    if (lights.length < MOST_LIGHTS) {
      chips.push(element("button", { type: "button", class: "chip", onclick: () => this.#add() }, "+ Add"));
    }
    const focused = this.chips.contains(document.activeElement) ? [...this.chips.children].indexOf(document.activeElement) : -1;
    this.chips.replaceChildren(...chips);
    if (focused >= 0) this.chips.children[Math.min(focused, chips.length - 1)].focus();
    this.detail.hidden = !this.light;
    if (!this.light) return;
    this.onBox.checked = this.light.on;
    for (const name of ["azimuth", "elevation", "intensity"]) this.sliders[name].set(this.light[name]);
    this.sliders.distance.set(this.partOf(this.light.distance));
  }
}
