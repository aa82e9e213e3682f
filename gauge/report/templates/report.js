// Sorting and filtering of the table of environments; without it the table stands complete in the suite's order.
(() => {
  const table = document.querySelector("table.all");
  if (!table) return;
  const body = table.tBodies[0];
  const statistics = { "show-mean50": ".q", "show-mean25": ".t", "show-mean": ".m" };
  const value = (row, column) => {
    const cell = row.cells[column];
    const chosen = statistics[document.querySelector("[name=statistic]:checked")?.id] ?? ".q";
    return cell.dataset.order ?? (cell.querySelector(chosen) ?? cell).textContent.trim();
  };
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      table.querySelectorAll("th[aria-sort]").forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...body.rows].map((row) => [value(row, column), row]);
      const number = (text) => (text === "–" || text === "" ? -Infinity : Number(text.replace("−", "-")));
      const compare = rows.some(([text]) => Number.isNaN(number(text)))
        ? (a, b) => a[0].localeCompare(b[0])
        : (a, b) => (number(a[0]) === number(b[0]) ? 0 : number(a[0]) - number(b[0]));
      rows.sort((a, b) => (down ? -compare(a, b) : compare(a, b)));
      body.append(...rows.map(([, row]) => row));
    });
  });
  const filter = document.querySelector("#filter");
  if (!filter) return;
  filter.parentElement.hidden = false;
  filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/);
    for (const row of body.rows) {
      const text = `${row.cells[0].textContent} ${row.lastElementChild.textContent}`.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
  });
})();
