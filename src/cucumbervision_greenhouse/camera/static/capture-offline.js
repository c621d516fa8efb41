// Keeps the capture page on the tablet, so that it opens and takes presses while the connection is lost.
const SHELF = "capture-1";
const PARTS = ["/capture", ...["capture.js", "presses.js", "picture.js", "picture.html", "picture.css", "theme.css", "theme.js", "capture.css", "capture.webmanifest", "icon.svg"].map((name) => `/capture/${name}`)];
const PATIENCE_MS = 3000;

self.addEventListener("install", (event) => {
  event.waitUntil(caches.open(SHELF).then((shelf) => shelf.addAll(PARTS)).then(() => self.skipWaiting()));
});
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));

// What the server has now comes first; what was kept, where it does not answer.
async function answer(request) {
  const shelf = await caches.open(SHELF);
  try {
    const found = await fetch(request, { signal: AbortSignal.timeout(PATIENCE_MS) });
    if (!found.ok) return found;
    // A file that stops halfway counts as no answer: with half a script the page would be dead.
    const whole = new Response(await found.blob(), found);
    shelf.put(new URL(request.url).pathname, whole.clone()).catch(() => {});
    return whole;
  } catch (fault) {
    // In another language than asked for rather than not at all.
    const kept = await shelf.match(request, { ignoreSearch: true, ignoreVary: true });
    if (kept) return kept;
    throw fault;
  }
}

self.addEventListener("fetch", (event) => {
  const { pathname, origin } = new URL(event.request.url);
  if (event.request.method === "GET" && origin === location.origin && PARTS.includes(pathname)) event.respondWith(answer(event.request));
});
