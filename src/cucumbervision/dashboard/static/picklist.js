// A list to be tapped off: each tap shows at once, and is sent with its number, so that none is lost or counted twice.
const state = new WeakMap();

export default function (component) {
  const { data, parentElement: root, setStateValue } = component;
  const own = state.get(root) || { taps: [], made: Math.random().toString(36).slice(2), mine: {} };
  state.set(root, own);
  const list = root.querySelector(".fruit");
  const isPicked = (one) => (one.key in own.mine ? own.mine[one.key] : one.picked);
  const total = () => {
    const done = data.fruit.filter(isPicked).length;
    root.querySelector(".total").textContent = `${done} of ${data.fruit.length} picked${data.words ? ` · ${data.words}` : ""}`;
  };
  for (const one of data.fruit) if (own.mine[one.key] === one.picked) delete own.mine[one.key];
  list.replaceChildren(...data.fruit.map((one) => {
    const line = document.createElement("button");
    line.type = "button";
    const part = (name, words) => {
      const node = document.createElement("span");
      node.className = name;
      node.textContent = words;
      line.appendChild(node);
      return node;
    };
    const box = part("box", "");
    part("says at", one.at);
    part("says", one.length);
    part("says", one.grade);
    const draw = () => {
      line.setAttribute("aria-pressed", String(isPicked(one)));
      box.textContent = isPicked(one) ? "✓" : "";
    };
    line.setAttribute("aria-label", `${one.at}, ${one.length}, ${one.grade}`);
    line.onclick = () => {
      own.mine[one.key] = !isPicked(one);
      own.taps = [...own.taps, { number: `${own.made}-${own.taps.length}-${Date.now()}`, key: one.key, picked: own.mine[one.key] }].slice(-200);
      setStateValue("taps", own.taps);
      draw();
      total();
    };
    draw();
    return line;
  }));
  total();
}
