// A picture with layers, a scale bar, a ruler, and a pointer or a box to prompt with.
const SVG = "http://www.w3.org/2000/svg";
const HINTS = {
  ruler: "Tap two points: the straight distance between them is measured in depth.",
  point: "Tap the middle of the fruit: its outline is drawn anew.",
  box: "Drag a box around the fruit: its outline is drawn anew.",
};
const NAMES = { ruler: "Ruler", point: "Correct by a tap", box: "Correct by a box" };
const state = new WeakMap();

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

function chip(parent, label, pressed, color, act) {
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
  parent.appendChild(node);
}

function drawLayer(svg, layer, unit) {
  for (const shape of layer.shapes) {
    const points = shape.points;
    if (shape.kind === "dot") {
      make("circle", { cx: points[0], cy: points[1], r: 4 * unit, fill: layer.color, stroke: "#000", "stroke-width": 1.5 * unit }, svg);
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

function drawBar(svg, bar, data, unit) {
  const x = 16 * unit, y = data.height - 18 * unit;
  make("line", { x1: x, y1: y, x2: x + bar.px, y2: y, stroke: "#000", "stroke-width": 8 * unit }, svg);
  make("line", { x1: x, y1: y, x2: x + bar.px, y2: y, stroke: "#fff", "stroke-width": 4 * unit }, svg);
  text(svg, bar.label, x, y - 10 * unit, 20 * unit);
}

function draw(root, data, own) {
  const svg = root.querySelector("svg");
  const unit = data.width / 900;
  svg.setAttribute("viewBox", `-0.5 -0.5 ${data.width} ${data.height}`);
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
  if (data.bar) drawBar(svg, data.bar, data, unit);
}

function chips(root, data, own, again) {
  const layers = root.querySelector(".layers"), tools = root.querySelector(".tools");
  layers.replaceChildren();
  tools.replaceChildren();
  const names = Object.keys(data.images);
  if (names.length > 1) {
    for (const name of names) chip(layers, name, own.image === name, "", () => { own.image = name; again(); });
  }
  for (const layer of data.layers) {
    chip(layers, layer.name, own.on[layer.name], layer.color, () => { own.on[layer.name] = !own.on[layer.name]; again(); });
  }
  for (const tool of data.tools) {
    chip(tools, NAMES[tool], own.tool === tool, "", () => {
      own.tool = own.tool === tool ? "" : tool;
      own.ends = [];
      own.drag = null;
      again();
    });
  }
  root.querySelector(".hint").textContent = HINTS[own.tool] || "";
}

export default function (component) {
  const { data, parentElement: root, setTriggerValue } = component;
  const own = state.get(root) || { image: "", on: {}, tool: "", ends: [], drag: null };
  state.set(root, own);
  for (const layer of data.layers) if (!(layer.name in own.on)) own.on[layer.name] = layer.on;
  const svg = root.querySelector("svg");
  const again = () => { draw(root, data, own); chips(root, data, own, again); };
  const at = (event) => {
    const matrix = svg.getScreenCTM().inverse();
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    const inside = (value, size) => Math.round(10 * Math.min(Math.max(value, 0), size - 1)) / 10;
    return [inside(point.x, data.width), inside(point.y, data.height)];
  };
  svg.onpointerdown = (event) => {
    if (own.tool !== "box") return;
    svg.setPointerCapture(event.pointerId);
    own.drag = [...at(event), ...at(event)];
  };
  svg.onpointermove = (event) => {
    if (own.tool !== "box" || !own.drag || !event.buttons) return;
    own.drag = [own.drag[0], own.drag[1], ...at(event)];
    draw(root, data, own);
  };
  svg.onpointerup = () => {
    if (own.tool !== "box" || !own.drag) return;
    const [x1, y1, x2, y2] = own.drag;
    if (Math.abs(x2 - x1) > 8 && Math.abs(y2 - y1) > 8) setTriggerValue("box", own.drag);
  };
  svg.onclick = (event) => {
    if (own.tool === "point") setTriggerValue("point", at(event));
    if (own.tool !== "ruler") return;
    own.ends = own.ends.length === 1 ? [own.ends[0], at(event)] : [at(event)];
    data.rulerText = "";
    draw(root, data, own);
    if (own.ends.length === 2) setTriggerValue("ruler", own.ends.flat());
  };
  again();
}
