// Tables: a click on a head sorts by this column, words in the field beside keep the rows that have them.
"use strict";
for (const frame of document.querySelectorAll(".table")) {
  const body = frame.querySelector("tbody");
  const value = (row, column) => {
    const text = row.cells[column].textContent.trim();
    const number = parseFloat(text.replace("−", "-"));
    return Number.isNaN(number) || !/^[-+−.\d]/.test(text) ? text : number;
  };
  const compare = (a, b) => {
    if (typeof a === typeof b) return typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
    return typeof a === "number" ? -1 : 1;
  };
  const sort = (head, column) => {
    const falls = head.getAttribute("aria-sort") === "ascending";
    frame.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", falls ? "descending" : "ascending");
    const rows = Array.from(body.rows, row => [value(row, column), row]);
    rows.sort((a, b) => falls ? compare(b[0], a[0]) : compare(a[0], b[0]));
    body.append(...rows.map(pair => pair[1]));
  };
  frame.querySelectorAll("th").forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => sort(head, column));
  });
  const search = frame.querySelector("input");
  if (search) search.addEventListener("input", () => {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of body.rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every(word => text.includes(word));
    }
  });
}
// A link into a closed part opens it.
const open = () => {
  const part = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (part && part.tagName === "DETAILS") { part.open = true; part.scrollIntoView(); }
};
addEventListener("hashchange", open);
open();
// On paper everything is shown.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(part => { part.open = true; }));
