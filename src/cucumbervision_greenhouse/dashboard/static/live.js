// The server's news on every page: the work and its time left, a lost connection. A page whose round changed is drawn anew.
const AGAIN_MS = 1000, SETTLE_MS = 400, LOST_MS = 1500, SILENCE_MS = 7000; // news come every 2 s
const LEAVING_MS = 10000; // a page that has not come by then does not come
const own = { line: null, round: null, page: null, version: "", asked: "", news: null, lost: false, root: null, trigger: null, begun: new Map(), leftAt: -Infinity };

function left(work) {
  const now = performance.now(), name = work.words.split(":")[0];
  if (!own.begun.has(name)) own.begun.set(name, { at: now, done: work.done });
  const from = own.begun.get(name), done = work.done - from.done;
  if (done < 1 || !work.total) return "";
  const s = ((now - from.at) / 1000 / done) * (work.total - work.done);
  const [words, many] = s < 90 ? [_("about {n} s left"), s] : [_("about {n} min left"), s / 60];
  return s < 5 ? "" : `, ${words.replace("{n}", Math.round(many))}`;
}

function draw() {
  const lost = own.root.querySelector(".lost"), work = own.root.querySelector(".work"), at = own.news?.work;
  lost.hidden = !own.lost;
  document.documentElement.toggleAttribute("data-lost", own.lost); // what Streamlit says of it is not shown
  lost.textContent = own.lost ? _("Connection to the camera computer lost; trying again.") : "";
  work.hidden = !at?.words || own.lost;
  if (!at?.words) { own.begun.clear(); return; }
  work.firstChild.textContent = at.words + left(at);
  const bar = work.querySelector("progress");
  bar.setAttribute("aria-label", at.words);
  if (at.total) Object.assign(bar, { max: at.total, value: at.done });
  else bar.removeAttribute("value");
}

// Between a tap and what it draws, Streamlit takes any message as of the page before: a link would not be followed, a closed field opened.
const isDrawing = () => performance.now() - own.leftAt < LEAVING_MS || document.querySelector("[data-test-script-state=running]");

function ask(version) {
  if (own.news.version !== version || version === own.version || version === own.asked) return;
  if (isDrawing()) { setTimeout(() => ask(version), SETTLE_MS); return; }
  own.asked = version;
  own.trigger("changed", { version, at: location.search });
}

function heard() {
  draw();
  const { version } = own.news;
  if (version === own.version || version === own.asked) return;
  setTimeout(() => ask(version), SETTLE_MS);
}

function listen() {
  own.line?.close();
  const line = own.line = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/news?round=${own.round}`);
  let late = 0;
  // A line that is half open brings nothing and does not close.
  const alive = () => {
    clearTimeout(own.watch);
    own.watch = setTimeout(() => { if (own.line === line) { own.lost = true; draw(); listen(); } }, SILENCE_MS);
  };
  alive();
  line.onopen = () => { own.lost = false; draw(); };
  line.onmessage = (event) => {
    if (own.line !== line) return;
    alive();
    own.news = JSON.parse(event.data);
    line.send("next");
    heard();
  };
  line.onclose = () => {
    if (own.line !== line) return;
    late = setTimeout(() => { own.lost = own.line?.readyState !== WebSocket.OPEN; draw(); }, LOST_MS);
    setTimeout(listen, AGAIN_MS);
  };
}

document.addEventListener("click", (event) => {
  const link = event.target.closest?.("[data-testid=stPageLink-NavLink]");
  if (link && new URL(link.href).pathname !== location.pathname) own.leftAt = performance.now();
}, true);

export default function (component) {
  const { data, parentElement: root, setTriggerValue } = component;
  if (data.go) { location.replace(data.go); return; }
  if (own.page !== data.page) Object.assign(own, { page: data.page, leftAt: -Infinity });
  Object.assign(own, { root, trigger: setTriggerValue, version: data.version });
  if (own.round !== data.round) {
    own.round = data.round;
    listen();
  }
  draw();
}
