// Rows as they hang: a finger, the mouse or the keys scroll them; two fingers, Ctrl and the wheel, or + and − enlarge them; a tap opens the nearest fruit.
const LEAST = 0.08, MOST = 3, NEAR_PX = 24; // pixels of a millimetre; how far from a fruit a thumb may land
const state = new WeakMap();

export default function (component) {
  const { data, parentElement: root, setTriggerValue } = component;
  const own = state.get(root) || { scale: 0, drawn: "", moved: 0 };
  state.set(root, own);
  const rows = root.querySelector(".rows"), strips = () => [...rows.querySelectorAll(".strip")];
  const place = (strip) => `${data.place} ${strip.getAttribute("aria-label")}`;
  const size = () => strips().forEach(({ firstChild: svg }) => {
    const { width, height } = svg.viewBox.baseVal;
    svg.style.cssText = `width: ${width * own.scale}px; height: ${height * own.scale}px`;
  });
  const zoom = (factor, at) => { // what lies at that place of the screen stays there
    const before = own.scale;
    own.scale = Math.min(Math.max(before * factor, LEAST), MOST);
    size();
    for (const strip of strips()) {
      const x = (at ?? innerWidth / 2) - strip.getBoundingClientRect().left;
      strip.scrollLeft = ((strip.scrollLeft + x) * own.scale) / before - x;
    }
  };
  if (own.drawn !== data.rows) {
    const before = Object.fromEntries(strips().map((strip) => [place(strip), strip.scrollLeft]));
    rows.innerHTML = own.drawn = data.rows;
    for (const link of rows.querySelectorAll("a")) link.setAttribute("href", data.address + link.dataset.key);
    rows.parentElement.classList.toggle("small", data.small);
    // A short row fills the screen.
    const widest = Math.max(...strips().map(({ firstChild: svg }) => svg.viewBox.baseVal.width));
    own.scale ||= data.small ? 0.16 : Math.min(Math.max(rows.clientWidth / widest, 0.42), 0.8);
    size();
    // Back from a fruit, the row is where it was.
    for (const strip of strips()) strip.scrollLeft = before[place(strip)] ?? sessionStorage.getItem(place(strip)) ?? 0;
    const opened = rows.querySelector(`[data-key="${data.opened}"]`);
    opened?.classList.add("open");
    opened?.scrollIntoView({ block: "nearest", inline: "center" });
  }
  root.querySelectorAll("button").forEach((button, k) => { button.onclick = () => zoom([1 / 1.4, 1.4][k]); });
  rows.onwheel = (event) => { if (event.ctrlKey) { event.preventDefault(); zoom(Math.exp(-event.deltaY / 300), event.clientX); } };
  rows.onpointerdown = () => { own.moved = 0; };
  rows.onpointermove = (event) => {
    if (event.pointerType !== "mouse" || !event.buttons) return;
    own.moved += Math.abs(event.movementX);
    event.target.closest(".strip")?.scrollBy(-event.movementX, -event.movementY);
  };
  const apart = ([one, other]) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
  rows.ontouchstart = (event) => { own.apart = event.touches.length === 2 ? apart(event.touches) : 0; };
  rows.ontouchmove = (event) => {
    if (!own.apart || event.touches.length !== 2) return;
    event.preventDefault();
    zoom(apart(event.touches) / own.apart, (event.touches[0].clientX + event.touches[1].clientX) / 2);
    own.apart = apart(event.touches);
  };
  rows.onclick = (event) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey) return; // the browser opens its address
    event.preventDefault();
    if (own.moved > 5) return;
    const away = (link) => {
      const box = link.querySelector(".body").getBoundingClientRect();
      return Math.hypot(Math.max(box.left - event.clientX, 0, event.clientX - box.right), Math.max(box.top - event.clientY, 0, event.clientY - box.bottom));
    };
    const links = [...(event.target.closest(".strip")?.querySelectorAll("a") || [])];
    const [nearest] = links.sort((one, other) => away(one) - away(other));
    const link = event.target.closest("a") || (nearest && away(nearest) < NEAR_PX && nearest);
    if (!link) return;
    for (const strip of strips()) sessionStorage.setItem(place(strip), strip.scrollLeft);
    setTriggerValue("opened", link.dataset.key);
  };
}
