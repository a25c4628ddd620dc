"use strict";
const plots = JSON.parse(document.getElementById("plots").textContent);
const root = document.documentElement;
const picker = document.getElementById("picker");
const BUTTONS = [["toImage", "zoom2d", "pan2d", "resetScale2d"]];
const dark = window.matchMedia("(prefers-color-scheme: dark)");

function color(name) {
  return getComputedStyle(root).getPropertyValue(name).trim();
}

// Strings such as "--robot" are names of the colours in the style sheet.
function themed(value) {
  if (typeof value === "string") return value.startsWith("--") ? color(value) : value;
  if (Array.isArray(value)) return typeof value[0] === "number" ? value : value.map(themed);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, themed(item)]));
}

function layout(plot) {
  const own = themed(plot.layout);
  for (const key of Object.keys(own).filter((name) => /^[xy]axis/.test(name))) {
    own[key] = {
      gridcolor: color("--grid"), zerolinecolor: color("--rule"), linecolor: color("--rule"),
      automargin: true, ...own[key],
    };
  }
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false,
    font: { color: color("--ink"), family: getComputedStyle(document.body).fontFamily, size: 13 },
    margin: { l: 56, r: 16, t: 28, b: 48 }, hovermode: "closest",
    modebar: { bgcolor: "rgba(0,0,0,0)", color: color("--muted"), activecolor: color("--ink") },
    hoverlabel: { bgcolor: color("--card"), bordercolor: color("--rule"),
                  font: { color: color("--ink") } },
    ...own,
  };
}

async function draw() {
  const chosen = picker ? Number(picker.value) : 0;
  for (const plot of plots) {
    const traces = plot.choices[plot.choices.length > 1 ? chosen : 0];
    const config = { responsive: true, displaylogo: false, modeBarButtons: BUTTONS };
    await Plotly.react(plot.id, themed(traces), layout(plot), config);
  }
  root.dataset.drawn = String(plots.length);
}

document.getElementById("theme").addEventListener("click", () => {
  const now = root.dataset.theme || (dark.matches ? "dark" : "light");
  root.dataset.theme = now === "dark" ? "light" : "dark";
  draw();
});
dark.addEventListener("change", draw);
if (picker) picker.addEventListener("change", draw);
draw();
