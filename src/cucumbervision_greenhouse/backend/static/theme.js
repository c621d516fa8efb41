// The colours that were chosen on this device, set before a page is drawn; and what the buttons in Streamlit's pages do.
{
  const STREAMLIT = `stActiveTheme-${location.pathname}-v2`; // where Streamlit keeps its choice
  const names = { light: "Light", dark: "Dark" };
  const ofDevice = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  const set = (theme) => {
    if (theme) document.documentElement.dataset.theme = theme;
    else delete document.documentElement.dataset.theme;
    localStorage.setItem(STREAMLIT, JSON.stringify(names[theme] || "System"));
  };
  set(localStorage.getItem("theme"));

  const acts = {
    theme: () => {
      const theme = (localStorage.getItem("theme") || ofDevice()) === "dark" ? "light" : "dark";
      if (theme === ofDevice()) localStorage.removeItem("theme");
      else localStorage.setItem("theme", theme);
      set(localStorage.getItem("theme"));
      if (document.querySelector(".stApp")) location.reload();
    },
    // The page to print is loaded unseen, and printed.
    print: (button) => {
      const frame = document.createElement("iframe");
      Object.assign(frame, { src: button.dataset.address, title: button.textContent, className: "quiet" });
      frame.onload = () => frame.contentWindow.print();
      document.querySelector("iframe.quiet")?.remove();
      document.body.append(frame);
    },
    send: async (button) => {
      const url = new URL(button.dataset.address, location.href).href;
      try {
        if (navigator.share) { await navigator.share({ title: document.title, url }); return; }
        await navigator.clipboard.writeText(url);
        button.textContent = button.dataset.done;
      } catch (fault) {
        // Without https a browser does not copy: the link is shown instead.
        if (fault.name !== "AbortError") prompt(button.textContent, url);
      }
    },
  };
  addEventListener("click", (event) => {
    const button = event.target.closest?.("button[data-act]");
    if (button) acts[button.dataset.act]?.(button);
  });
}
