// Elements of the page in few words; text is always text, never markup.
const SVG_NAMES = new Set(["svg", "circle", "line", "path", "g", "text"]);

function element(name, attributes = {}, ...children) {
  const made = SVG_NAMES.has(name)
    ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value != null) made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// A labelled slider; `show` turns its value into words.
function slider(label, { low, high, step, value, show, input }) {
  const said = element("output", {}, show(value));
  const range = element("input", { type: "range", min: low, max: high, step, "aria-label": label });
  range.value = value;
  const set = (to) => {
    range.value = to;
    said.textContent = show(to);
    range.setAttribute("aria-valuetext", show(to));
  };
  range.addEventListener("input", () => { set(Number(range.value)); input(Number(range.value)); });
  set(value);
  return { row: element("label", { class: "slider" }, element("span", {}, label), range, said), set };
}

const readJson = (id) => JSON.parse(document.getElementById(id).textContent);
