"use strict";
const book = JSON.parse(document.getElementById("book").textContent);
const root = document.documentElement;
const state = { hidden: new Set(), axis: book.axes[0] || "", group: "0" };
const all = (selector) => [...document.querySelectorAll(selector)];

// The numbers of a trace are a list, or one list per axis of the switch.
const chosen = (values) => Array.isArray(values) ? values : values[state.axis];

function themed() {
  const dark = root.dataset.theme === "dark";
  const axis = { gridcolor: dark ? "#2e3338" : "#e6e8ea", linecolor: dark ? "#555b61" : "#9aa0a6", zeroline: false,
    ticks: "outside", tickcolor: dark ? "#555b61" : "#9aa0a6", showline: true, automargin: true };
  const font = { color: dark ? "#e6e6e6" : "#1a1a1a", family: "system-ui, Segoe UI, sans-serif", size: 12 };
  const hoverlabel = { bgcolor: dark ? "#24292e" : "#ffffff", font: { color: font.color, size: 12 }, align: "left" };
  const modebar = { bgcolor: "rgba(0,0,0,0)", color: dark ? "#8a9097" : "#9aa0a6", activecolor: font.color };
  return { layout: { modebar, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font, hoverlabel, xaxis: axis,
    yaxis: axis, showlegend: false, hovermode: "x unified", hoverdistance: -1, margin: { l: 62, r: 20, t: 26, b: 44 } } };
}

// What is black on white is white on black.
const ink = (part) => part && part.color === "#000000" && root.dataset.theme === "dark"
  ? { ...part, color: "#ffffff" } : part;

function draw(chart) {
  const box = document.getElementById(chart.id);
  if (box.closest("[hidden]")) return;
  const traces = chart.data.filter((trace) => !state.hidden.has(trace.meta)).map((trace) => {
    trace = { ...trace };
    for (const part of ["line", "marker"]) if (trace[part]) trace[part] = ink(trace[part]);
    return { ...trace, x: chosen(trace.x), y: chosen(trace.y) };
  });
  const xaxis = { ...chart.layout.xaxis, ...((chart.xaxes || {})[state.axis] || {}) };
  if (xaxis.title) xaxis.unifiedhovertitle = { text: `${xaxis.title.text}: %{x:.4~g}` };
  Plotly.react(box, traces, { ...chart.layout, xaxis, template: themed(), uirevision: state.axis },
    { responsive: true, displaylogo: false, plotlyServerURL: "", // without the button that sends a chart to a server
      toImageButtonOptions: { format: "svg", filename: chart.title },
      modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]] });
}

const drawAll = () => book.charts.forEach(draw);
const press = (buttons, chosenOne) => buttons.forEach((b) => b.setAttribute("aria-pressed", String(b === chosenOne)));

all("[data-axis]").forEach((button, _, buttons) => button.addEventListener("click", () => {
  state.axis = button.dataset.axis;
  press(buttons, button);
  drawAll();
}));

function hide() {
  all(".chip").forEach((c) => c.setAttribute("aria-pressed", String(!state.hidden.has(c.dataset.key))));
  all("tr[data-key]").forEach((row) => { row.hidden = state.hidden.has(row.dataset.key); });
  drawAll();
}

all(".chip").forEach((chip, _, chips) => {
  const key = chip.dataset.key;
  chip.addEventListener("click", () => {
    state.hidden.has(key) ? state.hidden.delete(key) : state.hidden.add(key);
    hide();
  });
  chip.addEventListener("dblclick", () => { // two clicks cancel out
    const others = chips.map((c) => c.dataset.key).filter((k) => k !== key);
    const alone = !state.hidden.has(key) && others.every((k) => state.hidden.has(k));
    state.hidden = new Set(alone ? [] : others);
    hide();
  });
});

const select = document.getElementById("group");
if (select) select.addEventListener("change", () => {
  all("[data-group]").forEach((part) => { part.hidden = part.dataset.group !== select.value; });
  drawAll();
});

function cellValue(row, column) {
  const text = row.cells[column].textContent.trim();
  const number = parseFloat(text.replace("∞", "Infinity"));
  return Number.isNaN(number) ? (text === "-" || text === "" ? null : text) : number;
}

function sort(head) {
  const body = head.closest("table").tBodies[0], column = head.cellIndex;
  const down = head.getAttribute("aria-sort") === "ascending";
  [...head.parentNode.cells].forEach((cell) => cell.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const rows = [...body.rows].map((row) => ({ row, value: cellValue(row, column) }));
  const words = head.className === "name" || rows.some(({ value }) => typeof value === "string");
  const text = (row) => row.cells[column].textContent;
  rows.sort((a, b) => {
    if (a.value === null || b.value === null) return (a.value === null) - (b.value === null); // unknown last
    const order = words ? text(a.row).localeCompare(text(b.row)) : a.value < b.value ? -1 : Number(a.value > b.value);
    return down ? -order : order;
  });
  body.append(...rows.map(({ row }) => row));
}

all("thead th").forEach((head) => {
  head.tabIndex = 0;
  head.addEventListener("click", () => sort(head));
  head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(head); });
});

const prefers = matchMedia("(prefers-color-scheme: dark)");
function light(dark) {
  root.dataset.theme = dark ? "dark" : "light";
  document.getElementById("theme").textContent = dark ? "light" : "dark";
  drawAll();
}
document.getElementById("theme").addEventListener("click", () => light(root.dataset.theme !== "dark"));
prefers.addEventListener("change", () => light(prefers.matches));
light(prefers.matches);
