// A list of fruit, to be opened or tapped off: each tap shows at once, and is sent with its number, so that none is lost or counted twice.
// A fruit's line stays the same node: a tap that lasts while the list is drawn anew still arrives, and the focus stays.
const state = new WeakMap();

function add(parent, kind, name, words) {
  const node = document.createElement(kind);
  node.className = name;
  node.textContent = words;
  parent.appendChild(node);
  return node;
}

export default function (component) {
  const { data, parentElement: root, setStateValue, setTriggerValue } = component;
  const own = state.get(root) || { taps: [], made: Math.random().toString(36).slice(2), mine: {}, lines: new Map() };
  state.set(root, own);
  const list = root.querySelector(".fruit");
  list.setAttribute("aria-label", data.label);
  if (!own.heard) {
    root.host.id = "list"; // where the link at the page's top leads
    // On the click, not on a new address: so a key that follows at once finds the focus there, and the link works twice.
    own.heard = (event) => {
      if (!event.target.closest?.('a[href="#list"]') || document.getElementById("list") !== root.host) return;
      event.preventDefault();
      list.querySelector("button")?.focus();
    };
    addEventListener("click", own.heard);
  }
  const isPicked = (one) => (one.key in own.mine ? own.mine[one.key] : one.picked);
  const total = () => {
    const done = data.fruit.filter(isPicked).length;
    root.querySelector(".total").textContent = data.opens ? data.words : _("{done} of {all} picked").replace("{done}", done).replace("{all}", data.fruit.length) + (data.words ? ` · ${data.words}` : "");
  };
  for (const one of data.fruit) if (own.mine[one.key] === one.picked) delete own.mine[one.key];
  const lines = data.fruit.map((one) => {
    const line = own.lines.get(one.key) || Object.assign(document.createElement("button"), { type: "button" });
    own.lines.set(one.key, line);
    line.replaceChildren();
    const box = data.opens ? null : add(line, "span", "box", "");
    if (one.picture) Object.assign(add(line, "img", "", ""), { src: one.picture, alt: "" });
    const says = add(line, "span", "says", "");
    for (const words of one.says) if (words) add(says, "span", "", words);
    const draw = () => {
      if (data.opens) return;
      line.setAttribute("aria-pressed", String(isPicked(one)));
      box.textContent = isPicked(one) ? "✓" : "";
    };
    line.toggleAttribute("aria-current", one.key === data.opened);
    const pane = one.key === data.opened && own.opened !== data.opened && root.host.closest("[data-testid=stColumn]");
    if (pane) queueMicrotask(() => { pane.scrollTop += line.getBoundingClientRect().top - 200; own.opened = data.opened; });
    line.setAttribute("aria-label", one.says.filter(Boolean).join(", "));
    line.onclick = () => {
      if (data.opens) { setTriggerValue("opened", one.key); return; }
      own.mine[one.key] = !isPicked(one);
      own.taps = [...own.taps, { number: `${own.made}-${own.taps.length}-${Date.now()}`, key: one.key, picked: own.mine[one.key] }].slice(-200);
      setStateValue("taps", own.taps);
      draw();
      total();
    };
    draw();
    return line;
  });
  if (lines.length !== list.children.length || lines.some((line, k) => line !== list.children[k])) list.replaceChildren(...lines);
  total();
}
