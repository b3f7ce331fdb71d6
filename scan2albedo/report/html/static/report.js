// What a page starts with.
function openSection() {
  const section = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (section instanceof HTMLDetailsElement) {
    section.open = true;
    section.scrollIntoView({ behavior: "instant" });
  }
}

document.querySelectorAll(".viewer").forEach((root) => new FaceViewer(root));
document.querySelectorAll(".scan-table").forEach((root) => new ScanTable(root));
document.querySelector(".close-all")?.addEventListener("click", () => {
  document.querySelectorAll("details.scan[open]").forEach((section) => { section.open = false; });
});
addEventListener("hashchange", openSection);
openSection();
window.scan2albedo = { viewers };
