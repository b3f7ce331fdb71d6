// The nearest point of a line and its values, under the pointer or by the arrow keys.
function followPoints(chart) {
  const points = JSON.parse(chart.dataset.points), said = chart.parentElement.querySelector(".reading");
  const marker = element("circle", { r: 4, class: "marker" }), rest = said.textContent;
  marker.setAttribute("visibility", "hidden");
  chart.append(marker);
  let at = -1;
  const show = (index) => {
    at = clamp(index, 0, points.length - 1);
    const [x, y, text] = points[at];
    marker.setAttribute("cx", x);
    marker.setAttribute("cy", y);
    marker.setAttribute("visibility", "visible");
    said.textContent = text;
  };
  const leave = () => { marker.setAttribute("visibility", "hidden"); said.textContent = rest; };
  chart.addEventListener("pointermove", (event) => {
    const box = chart.getBoundingClientRect(), scale = chart.viewBox.baseVal.width / box.width;
    const x = (event.clientX - box.left) * scale, y = (event.clientY - box.top) * scale;
    let nearest = 0, least = Infinity;
    points.forEach((point, i) => {
      const far = Math.hypot(point[0] - x, 0.3 * (point[1] - y));
      if (far < least) { least = far; nearest = i; }
    });
    show(nearest);
  });
  chart.addEventListener("pointerleave", leave);
  chart.addEventListener("blur", leave);
  chart.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    show(at + step);
  });
}
