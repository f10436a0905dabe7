"use strict";
const $ = (id) => document.getElementById(id);
// A page that was left may stay in the browser for its back button: it must not receive updates.
window.WebSocket = class extends WebSocket {
  constructor(...args) { super(...args); addEventListener("pagehide", () => this.close()); }
};
addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });

const DIGITS = {rate: 1, not_ok: 0, nlos: 0, lost: 0, rx: 1};
const number = (value, digits = 3) => value == null || Number.isNaN(value) ? "-"
  : Math.abs(value) < 1e5 ? value.toFixed(digits) : value.toExponential(1);
const setText = (element, text) => { if (element.textContent !== text) element.textContent = text; };

function start(doc) {
  const model = (name) => doc.get_model_by_name(name);
  const controls = model("controls"), source = model("pairs"), position = $("position");
  let commands = 0;
  const send = (name, ...args) => { controls.command = [name, args, ++commands]; };
  const on = (name, show) => { controls.properties[name].change.connect(show); show(); };

  // The next update comes after this one has been drawn: a slow page skips updates instead of showing old ones.
  let received = performance.now();
  const showAge = () => {
    const player = controls.player, [, took, rangeAge] = controls.timing ?? [0, 0, -1], age = (performance.now() - received) / 1000 + took;
    const late = player?.behind ? "Reading ..." : age > 2 && (player?.playing ?? true) ? `${age.toFixed(0)} s behind`
      : player?.playing && !position && rangeAge < 0 ? "NO RANGES" : "";
    $("age").className = late ? "late" : "";
    setText($("age"), late || (!player?.playing ? "PAUSED" : position ? "PLAYING" : `LIVE ${(age + rangeAge).toFixed(1)} s`));
  };
  on("timing", () => {
    received = performance.now();
    const [update] = controls.timing;
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
  texts("events", "incidents", ([time, text]) => {
    if (time === null) return element("li", text);
    const button = element("button", `${time.toFixed(1)} s: ${text}`);
    button.addEventListener("click", () => send("seek", time));
    return element("li", button);
  });
  texts("notice", "notice", (text) => element("div", text));
  texts("cards", "cards", (lines) => element("div", lines.map((text, i) => element(i === 1 ? "strong" : "span", text))));
  const [headline, ...statements] = [...$("verdict").children, $("intervals")];
  on("headline", () => setText(headline, controls.headline));
  on("verdict", () => {
    const [state, , ...texts] = controls.verdict;
    $("verdict").className = state ?? "";
    statements.forEach((element, i) => setText(element, texts[i] ?? ""));
  });
  on("available", () => { for (const [id, is] of Object.entries(controls.available)) if ($(id)) $(id).disabled = !is; });

  // Tables: rows are kept, so that a click or the focus survives an update.
  const fill = (body, rows) => {
    while (body.rows.length > rows.length) body.lastChild.remove();
    rows.forEach((cells, i) => {
      const row = body.rows[i] ?? body.insertRow();
      cells.forEach((text, cell) => setText(row.cells[cell] ?? row.insertCell(), text));
    });
  };
  for (const [id, name] of [["tags", "tag_rows"], ["health", "health"], ["nodes", "nodes"]]) on(name, () => fill($(id), controls[name]));
  const body = $("pairs").tBodies[0];
  const drawPairs = () => {
    const {anchor, tag, no_data, ...columns} = source.data;
    fill(body, anchor.map((id, i) => [`${id}, ${tag[i]}`, ...Object.entries(columns).map(([name, values]) =>
      typeof values[i] === "string" ? values[i] : number(values[i], DIGITS[name]))]));
    anchor.forEach((id, i) => {
      const row = body.rows[i], selected = controls.selected?.join() === [id, tag[i]].join();
      row.tabIndex = 0;
      row.className = `${no_data[i] ? "no-data" : ""} ${selected ? "selected" : ""}`;
      row.setAttribute("aria-current", selected);
      row.cells[2].className = no_data[i] ? "" : columns.status[i];
    });
  };
  const select = (event) => {
    const i = event.target.closest("tr").sectionRowIndex;
    if (event.type === "click" || event.key === "Enter") send("select", source.data.anchor[i], source.data.tag[i]);
  };
  for (const type of ["click", "keydown"]) body.addEventListener(type, select);
  source.properties.data.change.connect(drawPairs);
  const titles = ["strip", "history", "cir"].map((name) => [$(`${name}-title`), $(`${name}-title`).textContent]);
  on("selected", () => {
    drawPairs();
    const [anchor, tag] = controls.selected ?? [];
    for (const [element, title] of titles) setText(element, anchor == null ? title : `${title}: anchor ${anchor}, tag ${tag}`);
  });
  on("empty", () => { for (const [name, message] of Object.entries(controls.empty)) $(name).dataset.empty = message; });
  // Map.
  const map = model("map");
  const fit = () => Bokeh.index.find_one(map).reset();
  // A name is on the first side where it covers no mark and no other name, else hidden: tags come first, then the selected anchor.
  const names = map.renderers.filter(({glyph}) => glyph.text), named = [...new Set(names.map((layer) => layer.data_source))].reverse();
  const placeNames = () => {
    const {x_scale, y_scale} = Bokeh.index.find_one(map).frame;
    const boxes = named.flatMap(({data: {x, y}}) => Array.from(x, (_, i) => [9, x_scale.compute(x[i]), y_scale.compute(y[i]) + 9]));
    for (const source of named) {
      const sides = names.filter((layer) => layer.data_source === source), {data} = source, places = [...data.x].map((_, i) => sides.find(({glyph}) => {
        const half = 3.5 * data[glyph.text.field][i].length + 5, toSide = {left: half, right: -half}[glyph.text_align.value] ?? 0;
        const box = [half, x_scale.compute(data.x[i]) + glyph.x_offset.value + toSide, y_scale.compute(data[glyph.y.field][i]) + glyph.y_offset.value];
        return boxes.every(([half, x, y]) => Math.abs(x - box[1]) > half + box[0] || Math.abs(y - box[2]) > 18) && boxes.push(box);
      }));
      for (const side of sides) {
        const booleans = places.map((place) => place === side);
        if (String(booleans) !== String(side.view.filter.booleans)) side.view.filter.setv({booleans}, {sync: false});
      }
    }
  };
  // Data, view and size of the map change without a common event.
  setInterval(placeNames, 200);
  $("fit").addEventListener("click", fit);
  $("accuracy").addEventListener("change", (event) => send("accuracy", event.target.checked));
  $("map").addEventListener("keydown", (event) => {
    const tool = map.toolbar.tools.find(({name}) => name === event.key);
    if (event.key === "0") fit(); else if (tool) tool.do.emit(); else return;
    event.preventDefault();
  });
  // A swipe over a figure scrolls the page of a touch screen: drag tools wait until they are chosen in the toolbar.
  const figures = [...document.querySelectorAll("[role=img]")].map((element) => model(element.id));
  if (matchMedia("(pointer: coarse)").matches)
    for (const figure of figures) for (const tool of figure.toolbar.tools) if (tool.event_types?.includes("pan")) tool.active = false;

  for (const figure of figures) new ResizeObserver(([{contentRect: {width}}]) => {
    for (const part of [...figure.above, ...figure.below]) if (part.items) part.ncols = Math.max(2, Math.floor((width - 40) / 110));
  }).observe($(figure.name));

  $("map").addEventListener("click", (event) => {
    const view = Bokeh.index.find_one(map), box = view.el.getBoundingClientRect(), {x_scale, y_scale} = view.frame, {x, y, id} = named[1].data;
    const i = id.findIndex((_, i) => Math.hypot(x_scale.compute(x[i]) - event.clientX + box.left, y_scale.compute(y[i]) - event.clientY + box.top) < 15);
    const {anchor, tag} = source.data, own = [...anchor.keys()].filter((pair) => BigInt(anchor[pair]) == id[i]);
    const pair = own.find((pair) => tag[pair] === controls.selected[1]) ?? own[0];
    if (pair !== undefined) send("select", anchor[pair], tag[pair]);
  });

  // Recording.
  let held = false, savedMs = 0;
  const saveUrl = (isPosition) => {
    // Browsers limit how often a page changes its URL.
    if (isPosition && controls.player?.playing && performance.now() < savedMs + 500) return;
    const [anchor, tag] = controls.selected ?? [], parts = new URLSearchParams(controls.selected ? {anchor, tag} : {});
    if (position && controls.player) parts.set("t", controls.player.position.toFixed(2));
    history.replaceState(null, "", `#${parts}`);
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
    $("speed").addEventListener("change", (event) => send("speed", Number(event.target.value)));
    on("marks", () => {
      if (!controls.marks) return;
      const {bad, incidents, faults, events} = controls.marks;
      const mark = (share, colour, text) => `<text x="${100 * share}%" y="11" fill="${colour}">${text}</text>`;
      $("bad-marks").innerHTML = bad.map((share) => mark(share, "#d55e00", "|")).join("")
        + incidents.map((share) => mark(share, "currentColor", "\u25c6")).join("");
      $("marks-legend").textContent = `whole recording: | ranges that need attention: ${faults}, \u25c6 events (list below): ${events}`;
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

  // A session ends with the viewer: the page reloads when the viewer is back.
  doc.on_event("connection_lost", () => {
    // What the page shows may be wrong by now.
    document.body.classList.add("disconnected");
    // The script, because the server makes a session for each request of the page; one request at a time, with the token.
    const script = new URL(document.querySelector("script[src*='bokeh.min.js']").src);
    script.search += location.search.replace("?", "&");
    const wait = async () => {
      try { if ((await fetch(script, {method: "HEAD", cache: "no-store", signal: AbortSignal.timeout(5000)})).ok) { location.reload(); return; } }
      catch { /* not yet */ }
      setTimeout(wait, 1000);
    };
    setTimeout(wait, 1000);
  });
}
const known = setInterval(() => {
  const doc = window.Bokeh?.documents[0];
  if (!doc?.is_idle) return;
  clearInterval(known);
  start(doc);
}, 30);
