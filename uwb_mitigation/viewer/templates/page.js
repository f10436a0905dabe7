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
  const controls = model("controls"), source = model("pairs"), position = $("position");
  let commands = 0;
  const send = (name, ...args) => { controls.command = [name, args, ++commands]; };
  const on = (name, show) => { controls.properties[name].change.connect(show); show(); };

  // The style sheet colours the frames of the figures; glyphs in the colours of the light page are inverted here.
  const night = matchMedia("(prefers-color-scheme: dark)"), inks = ["#111827", "#ffffff"];
  const invert = (colour) => inks[1 - inks.indexOf(colour)] ?? colour;
  night.addEventListener("change", () => location.reload());
  if (night.matches) for (const model of doc.all_models) for (const property of model) {
    const value = property.is_unset ? undefined : property.get_value();
    if (inks.includes(value?.value ?? value)) model.setv({[property.attr]: value.value ? {value: invert(value.value)} : invert(value)}, {sync: false});
    else if (property.attr === "palette" && value.length < 10) model.setv({palette: value.map(invert)}, {sync: false});
  }

  // The next update comes after this one has been drawn: a slow page skips updates instead of showing old ones.
  let received = performance.now();
  const showAge = () => {
    const player = controls.player, [, took, rangeAge, stampAge] = controls.update ?? [0, 0, -1, null], age = (performance.now() - received) / 1000 + took;
    const late = player?.behind ? "Reading ..." : age > 2 && (player?.playing ?? true) ? `${age.toFixed(0)} s behind`
      : player?.playing && !position && rangeAge < 0 ? "NO RANGES" : "";
    $("age").className = late ? "late" : "";
    setText($("age"), late || (!player?.playing ? "PAUSED" : position ? "PLAYING" : `LIVE ${(age + rangeAge).toFixed(1)} s${Math.abs(stampAge - rangeAge) > 1 ? `, stamps ${Math.abs(stampAge) < 1e5 ? (age + stampAge).toFixed(1) : "> 1e5"} s old` : ""}`));
  };
  on("update", () => {
    received = performance.now();
    const [update] = controls.update;
    requestAnimationFrame(() => setTimeout(() => { controls.acknowledged = update; }));
  });
  setInterval(showAge, 200);

  // Texts.
  const element = (tag, children) => {
    const made = document.createElement(tag);
    made.append(...[children].flat());
    return made;
  };
  const texts = (id, name, make) => on(name, () => $(id).replaceChildren(...controls[name].map(make)));
  for (const [id, name] of [["tags", "tag_rows"], ["health", "health"], ["nodes", "nodes"]])
    texts(id, name, (cells) => element("tr", cells.map((text) => element("td", text))));
  texts("events", "incidents", ([time, text]) => {
    if (time === null) return element("li", text);
    const button = element("button", `${time.toFixed(1)} s: ${text}`);
    button.addEventListener("click", () => send("seek", time));
    return element("li", button);
  });
  texts("notice", "notice", (text) => element("div", text));
  texts("cards", "cards", (lines) => element("div", lines.map((text, i) => element(i === 1 ? "strong" : "span", text))));
  on("verdict", () => {
    const [state, reason, action, facts] = controls.verdict, box = $("verdict");
    if (!state) return;
    box.className = state;
    [`Position ${state}${reason ? `: ${reason}` : ""}`, action, facts].forEach((text, i) => setText(box.children[i], text));
  });
  on("available", () => { for (const [id, is] of Object.entries(controls.available)) if ($(id)) $(id).disabled = !is; });
  on("summary", () => setText($("summary"), controls.summary));

  // Pairs: rows are kept, so that a click or the focus survives an update.
  const body = $("pairs").tBodies[0], rows = new Map();
  const fields = [...$("pairs").querySelectorAll("[data-sort]")].map((button) => button.dataset.sort);
  let sort = "pair", descending = false;
  const makeRow = (pair) => {
    const pick = element("button", pair.join(", ")), row = element("tr", fields.map(() => element("td", [])));
    pick.type = "button";
    pick.setAttribute("aria-label", `Select anchor ${pair[0]}, tag ${pair[1]}`);
    row.addEventListener("click", () => send("select", ...pair));
    fields.forEach((field, cell) => { row.cells[cell].className = {pair: "pair", state: "text state", status: "text"}[field] ?? ""; });
    row.cells[0].append(pick);
    return row;
  };
  const drawPairs = () => {
    const data = source.data, count = data.anchor.length, keys = Array.from({length: count}, (_, i) => i);
    const words = $("search").value.trim().toLowerCase(), filter = $("filter").value;
    const shown = keys.filter((i) => `${data.anchor[i]}, ${data.tag[i]}`.toLowerCase().includes(words)
      && {all: true, no_data: data.no_data[i], bad: data.status[i] !== "OK", not_good: !data.state[i].endsWith("good")}[filter]);
    const value = (i) => sort === "pair" ? i : data[sort][i];
    const compare = (a, b) => typeof a === "string" ? a.localeCompare(b) : Number.isNaN(a) - Number.isNaN(b) || a - b;
    shown.sort((a, b) => (descending ? -1 : 1) * compare(value(a), value(b)) || a - b);
    const drawn = shown.map((i) => {
      const key = `${data.anchor[i]} ${data.tag[i]}`;
      if (!rows.has(key)) rows.set(key, makeRow([data.anchor[i], data.tag[i]]));
      const row = rows.get(key);
      const selected = controls.selected?.join(" ") === key;
      row.className = `${data.no_data[i] ? "no-data" : ""} ${selected ? "selected" : ""}`;
      row.querySelector("button").setAttribute("aria-pressed", selected);
      fields.forEach((field, cell) => {
        if (field === "pair") return;
        const value = data[field][i];
        setText(row.cells[cell], typeof value === "string" ? value : number(value, DIGITS[field]));
        if (field === "status") row.cells[cell].className = `text ${data.no_data[i] ? "" : value}`;
      });
      return row;
    });
    if (drawn.length !== body.rows.length || drawn.some((row, i) => row !== body.rows[i])) {
      const focus = document.activeElement;
      body.replaceChildren(...drawn);
      if (body.contains(focus)) focus.focus();
    }
    const box = body.closest(".scroll"), hint = box.scrollWidth > box.clientWidth ? "; scroll the table sideways for more columns \u2192" : "";
    setText($("pairs-count"), `${shown.length} of ${count} pairs${hint}`);
  };
  let pressed = false;
  const updatePairs = () => { if (!pressed) drawPairs(); };
  body.addEventListener("pointerdown", () => { pressed = true; });
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { pressed = false; setTimeout(drawPairs); });
  source.properties.data.change.connect(updatePairs);
  const titles = ["strip", "history", "cir", "waterfall"].map((name) => [$(`${name}-title`), $(`${name}-title`).textContent]);
  on("selected", () => {
    drawPairs();
    const [anchor, tag] = controls.selected ?? [];
    for (const [element, title] of titles) setText(element, anchor == null ? title : `${title}: anchor ${anchor}, tag ${tag}`);
  });
  on("empty", () => {
    const {cir} = controls.empty;
    for (const [name, message] of Object.entries({...controls.empty, waterfall: cir ?? ""})) $(name).dataset.empty = message;
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
  const tags = map.renderers.map((r) => r.data_source).find((s) => s.name === "tags");
  tags.properties.data.change.connect(() => {
    if ($("follow").getAttribute("aria-pressed") !== "true") return;
    const i = Math.max(tags.data.name.findIndex((name) => name.split(":")[0] === `tag ${controls.selected?.[1]}`), 0);
    const [dx, dy] = ranges().map((range, axis) =>
      ((axis ? tags.data.y : tags.data.x)[i] - (range.start + range.end) / 2) / (range.end - range.start));
    if (Math.hypot(dx, dy) > 0.02) pan(dx, dy);
  });
  // A name that would cover another one is hidden: tags come first, then the selected anchor.
  const [anchors, labels] = ["id", "offset"].map((column) => map.renderers.map((r) => r.data_source).find((s) => column in s.data));
  const placeLabels = () => {
    const {x_scale, y_scale, bbox} = Bokeh.index.find_one(map).frame, boxes = [], shown = {x: [], y: [], text: [], offset: [], shift: []};
    // Above the marker, or below it where it would leave the frame or cover another one.
    const place = (x, y, text, ...offsets) => {
      const half = 3.5 * text.length + 2, px = x_scale.compute(x), py = y_scale.compute(y);
      const shift = Math.max(bbox.left - px + half, 0) + Math.min(bbox.right - px - half, 0);
      for (const offset of offsets) {
        const bottom = py + offset, box = [px - half + shift, bottom - 15, px + half + shift, bottom];
        if (box[1] < bbox.top || boxes.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) continue;
        boxes.push(box);
        for (const [name, value] of Object.entries({x, y, text, offset, shift})) shown[name].push(value);
        return;
      }
    };
    tags.data.x.forEach((x, i) => {
      const [px, py] = [x_scale.compute(x), y_scale.compute(tags.data.y[i])];
      boxes.push([px - 8, py - 3, px + 8, py + 8]);
    });
    tags.data.name.forEach((name, i) => place(tags.data.x[i], tags.data.label_y[i], name, -4, 2 * (y_scale.compute(tags.data.y[i]) - y_scale.compute(tags.data.label_y[i])) + 28));
    const isSelected = (i) => controls.selected && BigInt(controls.selected[0]) == anchors.data.id[i];
    const order = [...anchors.data.name.keys()].sort((a, b) => isSelected(b) - isSelected(a));
    for (const i of order) place(anchors.data.x[i], anchors.data.y[i], anchors.data.label[i], isSelected(i) ? -16 : -13, 28);
    if (JSON.stringify(shown) !== JSON.stringify(labels.data)) labels.setv({data: shown}, {sync: false});
  };
  tags.properties.data.change.connect(placeLabels);
  // The view and the size of the map change without a common event.
  setInterval(placeLabels, 200);
  $("fit").addEventListener("click", fit);
  $("follow").addEventListener("click", (event) =>
    event.target.setAttribute("aria-pressed", event.target.getAttribute("aria-pressed") !== "true"));
  for (const name of ["circles", "heat", "accuracy"]) $(name).addEventListener("change", (event) => send("show", name, event.target.checked));
  $("trail").addEventListener("change", (event) => send("trail", event.target.value));
  const keys = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 0.8], "-": [0, 0, 1.25]};
  $("map").addEventListener("keydown", (event) => {
    if (event.key === "0") fit(); else if (keys[event.key]) pan(...keys[event.key]); else return;
    event.preventDefault();
  });
  // A swipe over a figure scrolls the page of a touch screen: drag tools wait until they are chosen in the toolbar.
  const figures = [...document.querySelectorAll("[role=img]")].map((element) => model(element.id));
  if (matchMedia("(pointer: coarse)").matches)
    for (const figure of figures) for (const tool of figure.toolbar.tools) if (tool.event_types?.includes("pan")) tool.active = false;

  const legend = (figure) => [...figure.above, ...figure.below].find((part) => part.items);
  for (const figure of figures) if (legend(figure)) new ResizeObserver(([{contentRect: {width}}]) => {
    legend(figure).ncols = Math.max(2, Math.floor(width / (figure === map ? 125 : 110)));
  }).observe($(figure.name));

  $("map").addEventListener("click", (event) => {
    const view = Bokeh.index.find_one(map), box = view.el.getBoundingClientRect(), {x_scale, y_scale} = view.frame, {x, y, id} = anchors.data;
    const i = id.findIndex((_, i) => Math.hypot(x_scale.compute(x[i]) - event.clientX + box.left, y_scale.compute(y[i]) - event.clientY + box.top) < 15);
    if (i >= 0) send("select_anchor", id[i]);
  });

  const titleErrors = () => setText($("errors-title"), `Range errors, ${$("window")?.value ?? "since the start"}`);
  titleErrors();

  // Recording.
  let held = false, savedMs = 0;
  const saveUrl = (isPosition) => {
    const [anchor, tag] = controls.selected ?? [], at = controls.player?.position;
    const parts = {anchor, tag, t: position && at != null ? at.toFixed(2) : undefined, window: $("window")?.selectedIndex ? $("window").value : undefined};
    const text = Object.entries(parts).filter(([, value]) => value !== undefined).map(([name, value]) => `${name}=${encodeURIComponent(value)}`);
    // Browsers limit how often a page changes its URL.
    if (isPosition && controls.player?.playing && performance.now() < savedMs + 500) return;
    history.replaceState(null, "", "#" + text.join("&"));
    savedMs = performance.now();
  };
  const wanted = new URLSearchParams(location.hash.slice(1));
  if (wanted.has("t") && position) { send("play", false); send("seek", Number(wanted.get("t"))); }
  if (wanted.has("anchor")) send("select", wanted.get("anchor"), wanted.get("tag"));
  const toggle = () => send("play", !controls.player.playing);
  $("play").addEventListener("click", toggle);
  addEventListener("keydown", (event) => {
    if (event.key !== " " || event.target.matches("button, input:not([type=range]), select, summary")) return;
    event.preventDefault();
    toggle();
  });
  if (position) {
    position.addEventListener("input", () => { held = true; $("time").textContent = `${Number(position.value).toFixed(1)} s`; });
    position.addEventListener("change", () => { held = false; send("seek", Number(position.value)); });
    const steps = {ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10};
    position.addEventListener("keydown", (event) => {
      if (!steps[event.key]) return;
      event.preventDefault();
      position.value = Number(position.value) + steps[event.key];
      send("seek", Number(position.value));
    });
    for (const name of ["step", "previous_bad", "next_bad", "largest"]) $(name).addEventListener("click", () => send(name));
    $("window").addEventListener("change", (event) => { send("window", event.target.value); titleErrors(); saveUrl(false); });
    if (wanted.has("window")) { $("window").value = wanted.get("window"); titleErrors(); send("window", wanted.get("window")); }
    $("speed").addEventListener("change", (event) => send("speed", Number(event.target.value)));
    on("marks", () => {
      if (!controls.marks) return;
      const {bad, count, incidents, largest, truth} = controls.marks;
      const mark = (share, colour, text) => `<text x="${100 * share}%" y="11" fill="${colour}">${text}</text>`;
      $("bad-marks").innerHTML = bad.map((share) => mark(share, "#d55e00", "|")).join("")
        + incidents.map((share) => mark(share, "currentColor", "\u25c6")).join("")
        + (largest == null ? "" : mark(largest, "currentColor", `max ${truth ? "error" : "correction"}`));
      $("marks-legend").textContent = `| ${count} bad ranges, \u25c6 ${incidents.length} events`;
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
    saveUrl(true);
  });
  controls.properties.selected.change.connect(() => saveUrl(false));

  // Export.
  const quote = (value) => /[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : String(value);
  const csv = (name) => {
    const shown = name === "pairs" ? [source] : new Set(model(name).renderers.filter((r) => r.visible && r.data_source.name).map((r) => r.data_source));
    return [...shown].map(({name: title, data}) => {
      const columns = Object.keys(data), rows = Array.from(data[columns[0]], (_, i) => columns.map((column) => quote(data[column][i])));
      return rows.length ? [["data", ...columns], ...rows.map((row) => [title, ...row])].map((row) => row.join(",")).join("\n") + "\n" : "";
    }).filter(Boolean).join("\n");
  };
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
    $("age").hidden = true;
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
