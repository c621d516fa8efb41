// A fruit's depth points and its tube, drawn on a plain canvas.
const state = new WeakMap();

function turned(points, turn) {
  const [cy, sy, cx, sx] = [Math.cos(turn.yaw), Math.sin(turn.yaw), Math.cos(turn.pitch), Math.sin(turn.pitch)];
  const out = new Float32Array(points.length);
  for (let i = 0; i < points.length; i += 3) {
    const x = cy * points[i] + sy * points[i + 2];
    const z = -sy * points[i] + cy * points[i + 2];
    out[i] = x;
    out[i + 1] = cx * points[i + 1] - sx * z;
    out[i + 2] = sx * points[i + 1] + cx * z;
  }
  return out;
}

function draw(canvas, data, own) {
  const ratio = window.devicePixelRatio || 1;
  const width = (canvas.width = Math.max(1, canvas.clientWidth * ratio));
  const height = (canvas.height = Math.max(1, canvas.clientHeight * ratio));
  const pen = canvas.getContext("2d");
  const scale = own.zoom * Math.min(width, height) / own.size;
  const place = (p, i) => [width / 2 + scale * p[i], height / 2 + scale * p[i + 1]];
  pen.fillStyle = "#14181d";
  pen.fillRect(0, 0, width, height);
  const points = turned(data.points, own);
  const order = Array.from({ length: points.length / 3 }, (_, k) => k).sort((a, b) => points[3 * b + 2] - points[3 * a + 2]);
  const dot = Math.max(1.5, 1.4 * scale * own.size / 260);
  for (const k of order) {
    pen.fillStyle = data.colors[k];
    const [x, y] = place(points, 3 * k);
    pen.fillRect(x - dot / 2, y - dot / 2, dot, dot);
  }
  const line = (flat, color, thick) => {
    const moved = turned(flat, own);
    pen.strokeStyle = color;
    pen.lineWidth = thick * ratio;
    pen.beginPath();
    for (let i = 0; i < moved.length; i += 3) pen.lineTo(...place(moved, i));
    pen.stroke();
  };
  for (const ring of data.rings) line(ring, "rgba(86, 180, 233, 0.65)", 1);
  if (data.axis.length) line(data.axis, "#ffffff", 2.5);
  const bar = 50 * scale;
  pen.fillStyle = "#fff";
  pen.fillRect(16 * ratio, height - 20 * ratio, bar, 4 * ratio);
  pen.font = `${14 * ratio}px sans-serif`;
  pen.fillText("5 cm", 16 * ratio, height - 28 * ratio);
}

export default function (component) {
  const { data, parentElement: root } = component;
  const canvas = root.querySelector("canvas");
  const own = state.get(root) || { yaw: 0.5, pitch: -0.25, zoom: 1, fingers: new Map(), gap: 0 };
  state.set(root, own);
  let far = 1;
  for (const value of data.axis.length ? data.axis : data.points) far = Math.max(far, Math.abs(value));
  own.size = 2.5 * far;
  const again = () => draw(canvas, data, own);
  const zoom = (by) => { own.zoom = Math.min(Math.max(own.zoom * by, 0.3), 8); again(); };
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    own.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    own.gap = 0;
  };
  canvas.onpointermove = (event) => {
    const last = own.fingers.get(event.pointerId);
    if (!last) return;
    own.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (own.fingers.size === 1) {
      own.yaw += (event.clientX - last[0]) / 150;
      own.pitch += (event.clientY - last[1]) / 150;
      again();
    } else if (own.fingers.size === 2) {
      const [a, b] = [...own.fingers.values()];
      const gap = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (own.gap) zoom(gap / own.gap);
      own.gap = gap;
    }
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => { own.fingers.delete(event.pointerId); own.gap = 0; };
  canvas.onwheel = (event) => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15); };
  canvas.onkeydown = (event) => {
    const turns = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] }[event.key];
    if (turns) { own.yaw += turns[0]; own.pitch += turns[1]; again(); event.preventDefault(); }
    if (event.key === "+") zoom(1.15);
    if (event.key === "-") zoom(1 / 1.15);
  };
  const watcher = new ResizeObserver(again);
  watcher.observe(canvas);
  again();
  return () => watcher.disconnect();
}
