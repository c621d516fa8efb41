// A picture with layers, a scale bar, a ruler, and a pointer or a box to prompt with.
const SVG = "http://www.w3.org/2000/svg";
const HINTS = {
  "": _("Pinch or + and − to zoom, then drag to move; Ctrl and wheel with a mouse."),
  ruler: _("Tap two points: the straight distance between them is measured in depth."),
  point: _("Tap the middle of the fruit: its outline is drawn."),
  box: _("Drag a box around the fruit: its outline is drawn."),
};
const NAMES = { ruler: _("Ruler"), point: _("Redraw by tap"), box: _("Redraw by box") };
const ADDS = { point: _("Add by tap"), box: _("Add by box") };
const NEAREST = 20;
const PATIENCE_MS = 120000;
const state = new WeakMap();

async function post(path, content) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(content), signal: AbortSignal.timeout(PATIENCE_MS) });
  if (answer.ok) return answer.json();
  const { error } = await answer.json().catch(() => ({}));
  throw new Error(error || _("Not admitted: reload the page."));
}

// What outlining needs of a picture is computed while a finger is on its way; a tap without it only takes longer.
function prepare(data, own) {
  const asked = { stop: data.stop, capture: data.capture }, name = JSON.stringify(asked);
  if (!["point", "box"].includes(own.tool) || own.prepared === name) return;
  own.prepared = name;
  post("/api/prepare", asked).catch(() => { own.prepared = ""; });
}

// What was tapped is outlined at once, and measured then, as the outline of a fruit or as another fruit.
async function prompt(data, own, kind, value, redraw, send) {
  const asked = { stop: data.stop, capture: data.capture, [kind]: value };
  const tell = (words, draft) => { Object.assign(own, { told: words, draft }); redraw(); };
  tell(_("Outlining …"), []);
  try {
    const { outline } = await post("/api/outline", asked);
    tell(_("Measuring …"), outline);
    const { words, action } = await post("/api/fruit", data.adds ? asked : { ...asked, fruit: data.fruit });
    own.stale = true; // the next picture has it among its layers
    if (data.adds) { tell(words, outline); send("added", words); }
    else send("corrected", action); // the page that is drawn then says what became of it
  } catch (fault) { tell(fault.message, []); }
}

function make(name, attributes, parent) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (parent) parent.appendChild(node);
  return node;
}

function text(svg, words, x, y, size, anchor = "start") {
  const node = make("text", {
    x, y, "font-size": size, "font-family": "sans-serif", fill: "#fff", stroke: "#000",
    "stroke-width": size / 5, "stroke-linejoin": "round", "font-weight": 600, "paint-order": "stroke", "text-anchor": anchor,
  }, svg);
  node.textContent = words;
}

function chip(label, pressed, color, act) {
  const node = document.createElement("button");
  node.type = "button";
  node.setAttribute("aria-pressed", String(pressed));
  if (color) {
    const dot = document.createElement("span");
    dot.className = "dot";
    dot.style.background = color;
    node.appendChild(dot);
  }
  node.appendChild(document.createTextNode(label));
  node.onclick = act;
  return node;
}

// Chips that say the same stay: a tap that lasts while the page is drawn anew still arrives, and the focus stays.
function place(parent, nodes) {
  const before = [...parent.children];
  const isSame = before.length === nodes.length && before.every((node, k) => node.textContent === nodes[k].textContent);
  if (!isSame) { parent.replaceChildren(...nodes); return; }
  nodes.forEach((node, k) => {
    before[k].setAttribute("aria-pressed", node.getAttribute("aria-pressed"));
    before[k].onclick = node.onclick;
  });
}

function drawLayer(svg, layer, unit) {
  for (const shape of layer.shapes) {
    const points = shape.points;
    if (shape.kind === "dot") {
      make("circle", { cx: points[0], cy: points[1], r: 4 * unit, fill: layer.color, stroke: "#000", "stroke-width": 1.5 * unit }, svg);
      continue;
    }
    if (shape.kind === "label") {
      text(svg, shape.text, points[0], points[1], 18 * unit, "middle");
      continue;
    }
    const place = { points: points.join(" "), "stroke-linejoin": "round", "stroke-linecap": "round" };
    if (shape.kind === "area") {
      make("polygon", { ...place, fill: layer.color, "fill-opacity": 0.22, stroke: layer.color, "stroke-width": 2 * unit }, svg);
    } else {
      make("polyline", { ...place, fill: "none", stroke: "#000", "stroke-width": 4.5 * unit }, svg);
      make("polyline", { ...place, fill: "none", stroke: layer.color, "stroke-width": 2.5 * unit }, svg);
    }
  }
}

function drawRuler(svg, ends, words, unit) {
  if (ends.length === 2) {
    const [[x1, y1], [x2, y2]] = ends;
    make("line", { x1, y1, x2, y2, stroke: "#000", "stroke-width": 5 * unit }, svg);
    make("line", { x1, y1, x2, y2, stroke: "#ff0", "stroke-width": 2.5 * unit }, svg);
    if (words) text(svg, words, (x1 + x2) / 2, (y1 + y2) / 2 - 10 * unit, 20 * unit, "middle");
  }
  for (const [x, y] of ends) make("circle", { cx: x, cy: y, r: 6 * unit, fill: "#ff0", stroke: "#000", "stroke-width": 2 * unit }, svg);
}

function drawBar(svg, bar, view, unit) {
  const x = view.x + 16 * unit, y = view.y + view.h - 18 * unit;
  make("line", { x1: x, y1: y, x2: x + bar.px, y2: y, stroke: "#000", "stroke-width": 8 * unit }, svg);
  make("line", { x1: x, y1: y, x2: x + bar.px, y2: y, stroke: "#fff", "stroke-width": 4 * unit }, svg);
  text(svg, bar.label, x, y - 10 * unit, 20 * unit);
}

function draw(root, data, own) {
  const svg = root.querySelector("svg");
  const { x, y, w } = own.view, h = (w * data.height) / data.width;
  svg.setAttribute("viewBox", `${x} ${y} ${w} ${h}`); // before its size is read, which depends on it
  const box = svg.getBoundingClientRect(), wide = box.width || 900;
  own.size = `${box.width} ${box.height}`;
  const unit = own.unit = w / Math.min(900, 1.35 * wide); // words are read on a phone too
  // A finger on a picture that nobody zoomed scrolls the page.
  svg.style.touchAction = own.tool === "box" || own.zoomed ? "none" : "pan-y";
  svg.setAttribute("aria-label", data.title);
  svg.classList.toggle("drawing", own.tool !== "");
  svg.replaceChildren();
  const names = Object.keys(data.images);
  if (!names.includes(own.image)) own.image = names[0];
  make("image", { href: data.images[own.image], x: -0.5, y: -0.5, width: data.width, height: data.height, preserveAspectRatio: "none" }, svg);
  for (const layer of data.layers) if (own.on[layer.name]) drawLayer(svg, layer, unit);
  if (own.tool === "ruler") drawRuler(svg, own.ends, data.rulerText, unit);
  if (own.tool === "box" && own.drag) {
    const [x1, y1, x2, y2] = own.drag;
    make("rect", { x: Math.min(x1, x2), y: Math.min(y1, y2), width: Math.abs(x2 - x1), height: Math.abs(y2 - y1), fill: "none", stroke: "#ff0", "stroke-width": 3 * unit }, svg);
  }
  for (const line of own.draft) make("polygon", { points: line.join(" "), fill: "#ff0", "fill-opacity": 0.25, stroke: "#ff0", "stroke-width": 2.5 * unit, "stroke-dasharray": `${8 * unit}` }, svg);
  if (data.bar) drawBar(svg, data.bar, { x, y, w, h }, unit);
}

// Where the picture opens: on the fruit, with as much about it as is needed to know where it is.
function opening(data) {
  const whole = { x: -0.5, y: -0.5, w: data.width };
  if (!data.focus) return whole;
  const [x1, y1, x2, y2] = data.focus;
  const w = Math.min(data.width, Math.max(1.7 * (x2 - x1), (1.7 * (y2 - y1) * data.width) / data.height, data.width / 6));
  return held({ x: (x1 + x2) / 2 - w / 2, y: (y1 + y2) / 2 - (w * data.height) / data.width / 2, w }, data);
}

function held(view, data) {
  const w = Math.min(Math.max(view.w, data.width / NEAREST), data.width);
  const inside = (value, size, part) => Math.min(Math.max(value, -0.5), size - part - 0.5);
  return { x: inside(view.x, data.width, w), y: inside(view.y, data.height, (w * data.height) / data.width), w };
}

// Zoom so that a point of the picture stays where it is on the screen.
function zoomed(view, data, factor, [u, v]) {
  const w = Math.min(Math.max(view.w / factor, data.width / NEAREST), data.width);
  const share = w / view.w;
  return held({ x: u - (u - view.x) * share, y: v - (v - view.y) * share, w }, data);
}

function chips(root, data, own, again) {
  const layers = [], tools = [];
  const names = Object.keys(data.images);
  if (names.length > 1) {
    for (const name of names) layers.push(chip(name, own.image === name, "", () => { own.image = name; again(); }));
  }
  for (const layer of data.layers) {
    if (layer.detail && !own.details) continue;
    layers.push(chip(layer.name, own.on[layer.name], layer.color, () => { own.on[layer.name] = !own.on[layer.name]; again(); }));
  }
  if (data.layers.some((layer) => layer.detail)) layers.push(chip(_("Details"), own.details, "", () => { own.details = !own.details; again(); }));
  for (const tool of data.tools) {
    tools.push(chip((data.adds && ADDS[tool]) || NAMES[tool], own.tool === tool, "", () => {
      own.tool = own.tool === tool ? "" : tool;
      own.ends = [];
      own.drag = null;
      prepare(data, own);
      again();
    }));
  }
  const middle = () => [own.view.x + own.view.w / 2, own.view.y + (own.view.w * data.height) / data.width / 2];
  const look = (label, view, zoomed = true) => tools.push(chip(label, false, "", () => { Object.assign(own, { view: view(), zoomed }); again(); }));
  look("+", () => zoomed(own.view, data, 1.5, middle()));
  look("−", () => zoomed(own.view, data, 1 / 1.5, middle()));
  look(_("Whole"), () => ({ x: -0.5, y: -0.5, w: data.width }), false);
  tools.push(chip(_("Full screen"), false, "", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else root.host.requestFullscreen?.();
  }));
  place(root.querySelector(".layers"), layers);
  place(root.querySelector(".tools"), tools);
  root.querySelector(".hint").textContent = HINTS[own.tool];
}

export default function (component) {
  const { data, parentElement: root, setTriggerValue } = component;
  if (!state.has(root) && data.fruit && matchMedia("(max-width: 640px)").matches) root.host.scrollIntoView({ block: "start" });
  const own = state.get(root) || { image: "", on: {}, tool: "", ends: [], drag: null, draft: [], told: "", job: null, prepared: "", zoomed: false, details: false, fingers: new Map(), moved: false };
  state.set(root, own);
  if (own.stale) Object.assign(own, { stale: false, draft: [] });
  if (own.job !== data.job) Object.assign(own, { job: data.job, told: data.told, draft: [] });
  own.view = own.view || opening(data);
  prepare(data, own);
  for (const layer of data.layers) if (!(layer.name in own.on)) own.on[layer.name] = layer.on;
  const svg = root.querySelector("svg");
  const redraw = () => { draw(root, data, own); root.querySelector(".told").textContent = own.told; };
  own.redraw = redraw;
  // It tells of the first size too, at which all is drawn already.
  if (!own.sized) (own.sized = new ResizeObserver(([{ contentRect: { width, height } }]) => { if (width && `${width} ${height}` !== own.size) own.redraw(); })).observe(svg);
  const again = () => {
    redraw();
    chips(root, data, own, again);
  };
  const send = (kind, value) => prompt(data, own, kind, value, redraw, setTriggerValue);
  const raw = (event) => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    return [point.x, point.y];
  };
  const at = (event) => {
    const inside = (value, size) => Math.round(10 * Math.min(Math.max(value, 0), size - 1)) / 10;
    const [x, y] = raw(event);
    return [inside(x, data.width), inside(y, data.height)];
  };
  svg.onpointerdown = (event) => {
    own.fingers.set(event.pointerId, raw(event));
    own.moved = false;
    if (own.fingers.size > 1) {
      own.drag = null;
      draw(root, data, own);
      return;
    }
    if (own.tool !== "box") return;
    svg.setPointerCapture(event.pointerId);
    own.drag = [...at(event), ...at(event)];
  };
  svg.onpointermove = (event) => {
    const before = own.fingers.get(event.pointerId);
    if (!before || !event.buttons) return;
    const now = raw(event);
    if (own.fingers.size === 1 && own.drag) own.drag = [own.drag[0], own.drag[1], ...at(event)];
    else if (own.fingers.size > 1 || (own.tool === "" && (own.zoomed || event.pointerType === "mouse"))) {
      const other = [...own.fingers].find(([id]) => id !== event.pointerId)?.[1];
      const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      // Points are kept in the picture's own frame: what lies under a finger stays under it.
      own.zoomed = own.zoomed || own.fingers.size > 1;
      if (other && apart(before) > 1) own.view = zoomed(own.view, data, apart(now) / apart(before), other);
      else own.view = held({ x: own.view.x + before[0] - now[0], y: own.view.y + before[1] - now[1], w: own.view.w }, data);
      if (Math.hypot(before[0] - now[0], before[1] - now[1]) > own.view.w / 200) own.moved = true;
      draw(root, data, own);
      own.fingers.set(event.pointerId, raw(event));
      return;
    } else return;
    draw(root, data, own);
  };
  const lift = (event) => {
    own.fingers.delete(event.pointerId);
    if (own.drag) {
      const [x1, y1, x2, y2] = own.drag;
      if (Math.abs(x2 - x1) > 8 && Math.abs(y2 - y1) > 8) send("box", own.drag);
    }
  };
  svg.onpointerup = lift;
  svg.onpointercancel = lift;
  svg.onpointerleave = (event) => { if (!own.drag) own.fingers.delete(event.pointerId); };
  svg.onwheel = (event) => {
    if (!event.ctrlKey && !document.fullscreenElement) return; // the page scrolls
    event.preventDefault();
    own.zoomed = true;
    own.view = zoomed(own.view, data, Math.exp(-event.deltaY / 400), raw(event));
    draw(root, data, own);
  };
  svg.onclick = (event) => {
    if (own.moved) return;
    if (own.tool === "point") send("point", at(event));
    if (own.tool !== "ruler") return;
    own.ends = own.ends.length === 1 ? [own.ends[0], at(event)] : [at(event)];
    data.rulerText = "";
    draw(root, data, own);
    if (own.ends.length === 2) setTriggerValue("ruler", own.ends.flat());
  };
  again();
}
