"use strict";
const $ = (id) => document.getElementById(id);
// A page that was left may stay in the browser for its back button: it must not receive updates.
window.WebSocket = class extends WebSocket {
  constructor(...args) { super(...args); addEventListener("pagehide", () => this.close()); }
};
addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });

const DIGITS = {rate: 1, not_ok: 0, nlos: 0, lost: 0, rx: 1, fp: 1};
const number = (value, digits = 3) => value == null || Number.isNaN(value) ? "-"
  : Math.abs(value) < 1e5 ? value.toFixed(digits) : value.toExponential(1);
const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };

function start(doc) {
  const model = (name) => doc.get_model_by_name(name);
  const controls = model("controls"), source = model("pairs");
  let commands = 0;
  const send = (name, ...args) => { controls.command = [name, args, ++commands]; };
  const on = (name, show) => { controls.properties[name].change.connect(show); show(); };

  // Colours of the figures follow those of the page.
  const night = matchMedia("(prefers-color-scheme: dark)");
  night.addEventListener("change", () => send("dark", night.matches));
  if (night.matches) send("dark", true);

  // Texts.
  on("summary", () => setText($("summary"), controls.summary));
  on("notice", () => $("notice").replaceChildren(...controls.notice.map((line) => {
    const div = document.createElement("div");
    div.textContent = line;
    return div;
  })));
  on("nodes", () => $("nodes").replaceChildren(...controls.nodes.map(([name, level, symbol, message]) => {
    const row = document.createElement("tr");
    for (const text of [name, `${symbol} ${level}`, message]) row.insertCell().textContent = text;
    return row;
  })));

  // Pairs: rows are kept, so that a click or the focus survives an update.
  const body = $("pairs").tBodies[0], rows = new Map();
  const fields = [...$("pairs").querySelectorAll("[data-sort]")].map((button) => button.dataset.sort);
  let sort = "pair", descending = false;
  const makeRow = (data, i) => {
    const row = document.createElement("tr"), pick = document.createElement("button");
    for (const field of fields) row.insertCell().className = {pair: "pair", status: "text"}[field] ?? "";
    pick.type = "button";
    pick.textContent = `${data.anchor[i]}, ${data.tag[i]}`;
    pick.setAttribute("aria-label", `Select anchor ${data.anchor[i]}, tag ${data.tag[i]}`);
    const pair = [data.anchor[i], data.tag[i]];
    row.addEventListener("click", () => send("select", ...pair));
    row.cells[0].append(pick);
    return row;
  };
  const drawPairs = () => {
    const data = source.data, count = data.anchor.length, keys = Array.from({length: count}, (_, i) => i);
    const words = $("search").value.trim().toLowerCase(), filter = $("filter").value;
    const shown = keys.filter((i) => `${data.anchor[i]}, ${data.tag[i]}`.toLowerCase().includes(words)
      && (filter === "all" || (filter === "no_data" ? data.no_data[i] : data.status[i] !== "OK")));
    const value = (i) => sort === "pair" ? i : data[sort][i];
    const compare = (a, b) => typeof a === "string" ? a.localeCompare(b) : Number.isNaN(a) - Number.isNaN(b) || a - b;
    shown.sort((a, b) => (descending ? -1 : 1) * compare(value(a), value(b)) || a - b);
    const drawn = shown.map((i) => {
      const key = `${data.anchor[i]} ${data.tag[i]}`;
      if (!rows.has(key)) rows.set(key, makeRow(data, i));
      const row = rows.get(key);
      const selected = controls.selected?.join(" ") === key;
      row.className = `${data.no_data[i] ? "no-data" : ""} ${selected ? "selected" : ""}`;
      row.querySelector("button").setAttribute("aria-pressed", selected);
      fields.forEach((field, cell) => {
        if (field === "pair") return;
        const element = row.cells[cell];
        if (field !== "status") return setText(element, number(data[field][i], DIGITS[field]));
        const text = `${data.symbol[i]} ${data.status[i]}`;
        if (element.textContent === text) return;
        const symbol = document.createElement("span");
        symbol.style.color = data.colour[i] || "inherit";
        symbol.textContent = data.symbol[i];
        element.replaceChildren(symbol, ` ${data.status[i]}`);
      });
      return row;
    });
    if (drawn.length !== body.rows.length || drawn.some((row, i) => row !== body.rows[i])) {
      const focus = document.activeElement;
      body.replaceChildren(...drawn);
      if (body.contains(focus)) focus.focus();
    }
    setText($("pairs-count"), `${shown.length} of ${count} pairs`);
  };
  let pressed = false;
  const updatePairs = () => { if (!pressed) drawPairs(); };
  body.addEventListener("pointerdown", () => { pressed = true; });
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { pressed = false; setTimeout(drawPairs); });
  source.properties.data.change.connect(updatePairs);
  on("selected", () => {
    drawPairs();
    const [anchor, tag] = controls.selected ?? [];
    const title = anchor == null ? "" : `: anchor ${anchor}, tag ${tag}`;
    for (const [name, head] of [["strip", "Range"], ["cir", "CIR"]]) setText($(`${name}-title`), head + title);
  });
  for (const name of ["search", "filter"]) $(name).addEventListener("input", drawPairs);
  for (const button of document.querySelectorAll("[data-sort]")) button.addEventListener("click", () => {
    descending = sort === button.dataset.sort && !descending;
    for (const th of document.querySelectorAll("#pairs th")) th.removeAttribute("aria-sort");
    sort = button.dataset.sort;
    button.closest("th").setAttribute("aria-sort", descending ? "descending" : "ascending");
    drawPairs();
  });

  // Map.
  const map = model("map"), ranges = () => [map.x_range, map.y_range];
  const fit = () => { $("follow").setAttribute("aria-pressed", "false"); Bokeh.index.find_one(map).reset(); };
  const pan = (x, y, zoom = 1) => {
    const view = Bokeh.index.find_one(map);
    const moved = ranges().map((range, axis) => {
      const middle = (range.start + range.end) / 2 + [x, y][axis] * (range.end - range.start);
      const half = (range.end - range.start) / 2 * zoom;
      return [range, {start: middle - half, end: middle + half}];
    });
    view.update_range({xrs: new Map([moved[0]]), yrs: new Map([moved[1]])}, {panning: zoom === 1, scrolling: zoom !== 1});
  };
  const tags = map.renderers.map((r) => r.data_source).find((s) => "protection" in s.data);
  tags.properties.data.change.connect(() => {
    if ($("follow").getAttribute("aria-pressed") !== "true") return;
    const i = Math.max(tags.data.name.findIndex((name) => name === `tag_${controls.selected?.[1]}`), 0);
    const [dx, dy] = ranges().map((range, axis) =>
      ((axis ? tags.data.y : tags.data.x)[i] - (range.start + range.end) / 2) / (range.end - range.start));
    if (Math.hypot(dx, dy) > 0.02) pan(dx, dy);
  });
  $("fit").addEventListener("click", fit);
  $("follow").addEventListener("click", (event) =>
    event.target.setAttribute("aria-pressed", event.target.getAttribute("aria-pressed") !== "true"));
  $("circles").addEventListener("change", (event) => {
    for (const name of ["raw_circles", "range_circles"]) model(name).visible = event.target.checked;
  });
  $("heat").addEventListener("change", (event) => send("heat", event.target.checked));
  const keys = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 0.8], "-": [0, 0, 1.25]};
  $("map").addEventListener("keydown", (event) => {
    if (event.key === "0") fit(); else if (keys[event.key]) pan(...keys[event.key]); else return;
    event.preventDefault();
  });
  // A swipe over a figure scrolls the page of a touch screen: drag tools wait until they are chosen in the toolbar.
  const figures = [...document.querySelectorAll("[role=img]")].map((element) => model(element.id));
  if (matchMedia("(pointer: coarse)").matches)
    for (const figure of figures) for (const tool of figure.toolbar.tools) if (tool.event_types?.includes("pan")) tool.active = false;

  new ResizeObserver(([{contentRect}]) => { map.below.find((part) => part.items).ncols = contentRect.width < 500 ? 2 : 4; }).observe($("map"));

  // Values at a click or tap.
  const lines = (figure) => figure.renderers.filter((r) => r.glyph?.type === "Line" || r.glyph?.type === "Quad");
  for (const figure of figures) if (figure.name !== "waterfall") $(figure.name).addEventListener("click", (event) => {
    const view = Bokeh.index.find_one(figure), box = view.el.getBoundingClientRect();
    const frame = view.frame, x = frame.x_scale.invert(event.clientX - box.left), y = frame.y_scale.invert(event.clientY - box.top);
    const axis = figure.below.find((part) => part.axis_label)?.axis_label;
    const parts = figure.name === "map" ? [`x ${number(x, 2)} m, y ${number(y, 2)} m`] : [`${number(x, 2)} (${axis})`];
    if (figure.name !== "map") for (const {glyph, data_source: {data}} of lines(figure)) {
      const quad = glyph.type === "Quad", column = quad ? glyph.top.field : glyph.y.field, xs = data[quad ? "left" : glyph.x.field];
      if (!data[column]?.length) continue;
      let best = 0;
      for (let i = 1; i < xs.length; i++) if (quad ? xs[i] <= x : Math.abs(xs[i] - x) < Math.abs(xs[best] - x)) best = i;
      if (!quad || data.right[best] >= x) parts.push(`${column === "range" ? "corrected" : column} ${number(data[column][best])}`);
    }
    setText($(`${figure.name}-values`), parts.join("; "));
  });

  // Recording.
  const position = $("position");
  let held = false, saved_s = 0;
  const saveUrl = () => {
    const [anchor, tag] = controls.selected ?? [], at = controls.player?.position;
    const parts = {anchor, tag, t: position && at != null ? at.toFixed(2) : undefined};
    const text = Object.entries(parts).filter(([, value]) => value !== undefined).map(([name, value]) => `${name}=${value}`);
    if (performance.now() > saved_s + 500 || !controls.player?.playing) history.replaceState(null, "", "#" + text.join("&"));
    else return;
    saved_s = performance.now();
  };
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.has("t") && position) { send("play", false); send("seek", Number(wanted.get("t"))); }
  if (wanted.has("anchor")) send("select", wanted.get("anchor"), wanted.get("tag"));
  $("play").addEventListener("click", () => send("play", !controls.player.playing));
  if (position) {
    position.addEventListener("input", () => { held = true; $("time").textContent = `${Number(position.value).toFixed(1)} s`; });
    position.addEventListener("change", () => { held = false; send("seek", Number(position.value)); });
    for (const name of ["step", "next_bad", "largest"]) $(name).addEventListener("click", () => send(name));
    $("speed").addEventListener("change", (event) => send("speed", Number(event.target.value)));
    on("marks", () => {
      if (!controls.marks) return;
      const {bad, count, largest, truth} = controls.marks, marks = $("bad-marks");
      const draw = (share, text, colour) => {
        const mark = document.createElementNS("http://www.w3.org/2000/svg", "text");
        for (const [name, value] of Object.entries({x: `${100 * share}%`, y: 11, fill: colour, "font-size": 11, "text-anchor": "middle"}))
          mark.setAttribute(name, value);
        mark.textContent = text;
        return mark;
      };
      marks.style.overflow = "visible";
      marks.replaceChildren(...bad.map((share) => draw(share, "|", "#d55e00")));
      if (largest != null) marks.append(draw(largest, "\u25b2", "currentColor"));
      $("marks-legend").textContent = `| ranges that are not OK: ${count || "none"}; \u25b2 largest ${truth ? "error" : "correction"}`;
    });
  }
  on("player", () => {
    const player = controls.player;
    if (!player) return;
    setText($("play"), player.playing ? "Pause" : position ? "Play" : "Resume");
    if (position) {
      position.max = player.seconds;
      if (!held) {
        position.value = player.position;
        setText($("time"), `${player.position.toFixed(1)} s of ${player.seconds.toFixed(1)} s`);
      }
      $("speed").value = player.speed.toFixed(1);
    }
    saveUrl();
  });
  controls.properties.selected.change.connect(saveUrl);

  // Export.
  const quote = (value) => /[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : String(value);
  const table = (name) => name === "pairs" ? {pairs: source.data}
    : Object.fromEntries(model(name).renderers.filter((r) => r.visible && !("corner_x" in r.data_source.data) && r.glyph.type !== "ImageURL")
      .map((r) => [r.data_source.id, r.data_source.data]));
  const csv = (name) => Object.values(table(name)).filter((data) => Object.values(data)[0]?.length).map((data) => {
    const columns = Object.keys(data).filter((column) => column !== "image"), length = data[columns[0]]?.length ?? 0;
    return [columns.join(","), ...Array.from({length}, (_, i) => columns.map((column) => quote(data[column][i])).join(","))].join("\n");
  }).join("\n\n") + "\n";
  window.exported = {};
  for (const button of document.querySelectorAll("[data-export]")) button.addEventListener("click", async () => {
    const {export: name, format} = button.dataset;
    const blob = format === "csv" ? new Blob([csv(name)], {type: "text/csv"}) : await Bokeh.index.find_one(model(name)).export(format).to_blob();
    const link = document.createElement("a");
    link.download = `uwb-${name}-${new Date().toISOString().replace(/[:.]/g, "-")}.${format}`;
    link.href = URL.createObjectURL(blob);
    link.click();
    window.exported[`${name}.${format}`] = blob;
  });

  // A session ends with the viewer: the page reloads when the viewer is back.
  doc.on_event("connection_lost", () => {
    $("lost").style.display = "block";
    const wait = setInterval(async () => {
      try { if ((await fetch(location.href, {cache: "no-store"})).ok) { clearInterval(wait); location.reload(); } }
      catch { /* not yet */ }
    }, 1000);
  });
}
const known = setInterval(() => {
  const doc = window.Bokeh?.documents[0];
  if (!doc?.is_idle) return;
  clearInterval(known);
  start(doc);
}, 30);
