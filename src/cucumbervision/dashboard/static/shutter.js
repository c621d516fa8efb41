// The capture button: tells the time of each press at once, whatever the server is doing, with a click and a flash.
const state = new WeakMap();
const KEPT = 50;
let sound = null;

// Streamlit gives a page up where parts that draw themselves meet one that is drawn anew (its issue 15084): what was
// pressed is kept by then, and the walk goes on in a fresh page.
window.addEventListener("error", (event) => {
  if (/delta path|setIn/.test(event.message)) location.reload();
});

function click() {
  try {
    sound = sound || new AudioContext();
    sound.resume();
    const length = Math.round(0.06 * sound.sampleRate);
    const buffer = sound.createBuffer(1, length, sound.sampleRate);
    const data = buffer.getChannelData(0);
    for (let k = 0; k < length; k += 1) data[k] = (Math.random() * 2 - 1) * Math.exp(-12 * k / length);
    const source = sound.createBufferSource();
    source.buffer = buffer;
    source.connect(sound.destination);
    source.start();
  } catch { /* A browser without sound still takes pictures. */ }
}

function flash() {
  const cover = document.createElement("div");
  cover.className = "cucumbervision-flash";
  cover.style.cssText = "position:fixed;inset:0;background:#fff;pointer-events:none;z-index:999999";
  document.body.appendChild(cover);
  cover.animate([{ opacity: 0.85 }, { opacity: 0 }], { duration: 260, easing: "ease-out" }).onfinish = () => cover.remove();
}

// A clock that nobody sets.
const now_s = () => (performance.timeOrigin + performance.now()) / 1000;

export default function (component) {
  const { data, parentElement: root, setStateValue } = component;
  const own = state.get(root) || { presses: [], offset_s: Infinity, made: Math.random().toString(36).slice(2) };
  state.set(root, own);
  // Our clock less the server's, as far as the quickest message so far tells.
  own.offset_s = Math.min(own.offset_s, now_s() - data.now_s);
  const button = root.querySelector("button");
  const draw = () => {
    root.querySelector(".word").textContent = data.label;
    const pressed = own.presses.length;
    root.querySelector(".count").textContent = data.words || (pressed ? `${pressed} pressed` : "");
  };
  button.disabled = data.disabled;
  button.setAttribute("aria-label", data.label);
  const press = () => {
    if (button.disabled) return;
    const one = { number: `${own.made}-${own.presses.length}-${Date.now()}`, at_s: now_s() - own.offset_s };
    own.presses = [...own.presses, one].slice(-KEPT);
    setStateValue("presses", own.presses);
    click();
    flash();
    draw();
  };
  // At the touch, not when the finger leaves; a press of a key comes as a click without a pointer.
  button.onpointerdown = (event) => { if (event.isPrimary && event.button === 0) press(); };
  button.onclick = (event) => { if (event.detail === 0) press(); };
  const onKey = (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    const target = event.composedPath()[0]; // the event's own target is only the host of a shadow tree
    // A key that is held down clicks the button again and again.
    if (target === button && event.repeat) event.preventDefault();
    const takesKeys = /^(input|textarea|select|button)$/i.test(target.tagName || "");
    if (event.key === "Enter" && !event.repeat && !takesKeys) press();
  };
  // The one handler of the document: this function runs at every redraw, and Streamlit calls only the last clean-up.
  document.onkeydown = onKey;
  draw();
  return () => { if (document.onkeydown === onKey) document.onkeydown = null; };
}
