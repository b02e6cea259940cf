// Tables sort at a click on a heading; arrows and Escape lead through photographs that are enlarged.
(() => {
  "use strict";
  const NUMBER = /^[-+−]?\d+(\.\d+)?(e[-+]?\d+)?(?=$|[\s%°×])/i;
  const NONE = new Set(["", "–"]);
  const order = new Intl.Collator(undefined, { numeric: true });

  function value(row, column) {
    return row.cells[column].textContent.trim();
  }

  function compare(rows, column) {
    const known = rows.map((row) => value(row, column)).filter((text) => !NONE.has(text));
    const numbers = known.every((text) => NUMBER.test(text));
    return (a, b) => (numbers ? parseFloat(a.replace("−", "-")) - parseFloat(b.replace("−", "-")) : order.compare(a, b));
  }

  function sort(table, head, column, original) {
    const was = head.getAttribute("aria-sort");
    const now = was === "ascending" ? "descending" : was === "descending" ? "none" : "ascending";
    for (const other of table.tHead.querySelectorAll("[aria-sort]")) other.setAttribute("aria-sort", "none");
    head.setAttribute("aria-sort", now);
    const rows = [...original];
    if (now !== "none") {
      const less = compare(rows, column);
      const sign = now === "ascending" ? 1 : -1;
      rows.sort((a, b) => {
        const [one, two] = [value(a, column), value(b, column)];
        const missing = NONE.has(one) - NONE.has(two);
        return missing || (NONE.has(one) ? 0 : sign * less(one, two));
      });
    }
    table.tBodies[0].append(...rows);
  }

  for (const table of document.querySelectorAll("table:not(.facts)")) {
    const original = [...table.tBodies[0].rows];
    if (original.length < 2) continue;
    [...table.tHead.rows[table.tHead.rows.length - 1].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.title = "sort";
      button.append(...head.childNodes);
      head.append(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => sort(table, head, column, original));
    });
  }

  document.addEventListener("keydown", (event) => {
    const shown = document.querySelector(".photo:target");
    const step = { ArrowLeft: 0, ArrowRight: 1, Escape: 2 }[event.key];
    if (!shown || step === undefined) return;
    event.preventDefault();
    shown.querySelectorAll(".steps a")[step].click();
  });
})();
