// Tables that are sorted by a click on a header, filtered by words and states, and shown page by page.
const PAGE = 25;

class ScanTable {
  constructor(root) {
    this.root = root;
    this.body = root.querySelector("tbody");
    this.rows = [...this.body.rows].map((row, order) => ({
      row, order, status: row.dataset.status, text: row.textContent.toLowerCase(),
      keys: [...row.cells].map((cell) => cell.dataset.value ?? cell.textContent.trim()),
    }));
    this.heads = [...root.querySelectorAll("th")];
    this.numeric = this.heads.map((head) => head.classList.contains("number"));
    this.sorted = { column: -1, down: false };
    this.page = 0;
    this.status = "";
    this.heads.forEach((head, column) => {
      head.querySelector("button")?.addEventListener("click", () => this.sort(column));
    });
    this.search = root.querySelector("input[type=search]");
    this.search.addEventListener("input", () => { this.page = 0; this.show(); });
    root.querySelectorAll("[data-show]").forEach((button) => button.addEventListener("click", () => {
      this.status = button.dataset.show;
      root.querySelectorAll("[data-show]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
      this.page = 0;
      this.show();
    }));
    this.failuresFirst = root.querySelector(".failures-first");
    this.failuresFirst?.addEventListener("click", () => {
      const pressed = this.failuresFirst.getAttribute("aria-pressed") !== "true";
      this.failuresFirst.setAttribute("aria-pressed", String(pressed));
      this.page = 0;
      this.show();
    });
    this.pager = root.querySelector(".pager");
    this.counted = root.querySelector(".counted");
    this.show();
  }

  sort(column) {
    const again = this.sorted.column === column;
    this.sorted = { column, down: again ? !this.sorted.down : this.numeric[column] };
    this.heads.forEach((head, k) => {
      if (k === column) head.setAttribute("aria-sort", this.sorted.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    this.page = 0;
    this.show();
  }

  #compare(a, b) {
    if (this.failuresFirst?.getAttribute("aria-pressed") === "true") {
      const failed = (a.status === "done") - (b.status === "done");
      if (failed) return failed;
    }
    const { column, down } = this.sorted;
    if (column < 0) return a.order - b.order;
    const [first, second] = [a.keys[column], b.keys[column]];
    // What is not known comes last, whichever way.
    if (first === "" || second === "") return (first === "") - (second === "") || a.order - b.order;
    const difference = this.numeric[column] ? Number(first) - Number(second)
      : first.localeCompare(second, undefined, { numeric: true });
    return (down ? -difference : difference) || a.order - b.order;
  }

  show() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = this.rows.filter(({ status, text }) => (!this.status || status === this.status)
      && words.every((word) => text.includes(word)));
    found.sort((a, b) => this.#compare(a, b));
    const pages = Math.max(1, Math.ceil(found.length / PAGE));
    this.page = Math.min(this.page, pages - 1);
    this.body.replaceChildren(...found.slice(this.page * PAGE, (this.page + 1) * PAGE).map(({ row }) => row));
    this.counted.textContent = found.length === this.rows.length ? `${found.length} scans` : `${found.length} of ${this.rows.length} scans`;
    this.#showPager(pages);
  }

  #showPager(pages) {
    this.pager.hidden = pages < 2;
    if (pages < 2) return;
    const button = (label, step, possible) => element("button", {
      type: "button", disabled: !possible, onclick: () => { this.page += step; this.show(); },
    }, label);
    this.pager.replaceChildren(button("Previous", -1, this.page > 0),
      element("span", {}, `Page ${this.page + 1} of ${pages}`), button("Next", 1, this.page < pages - 1));
  }
}
