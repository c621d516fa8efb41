// Light or dark as chosen on this device, set before the page is drawn; without a choice, as the device has it.
{
  const ofDevice = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  const chosen = () => localStorage.getItem("theme");
  const set = () => {
    if (chosen()) document.documentElement.dataset.theme = chosen();
    else delete document.documentElement.dataset.theme;
  };
  set();
  addEventListener("click", (event) => {
    if (event.target.id !== "theme") return;
    const theme = (chosen() || ofDevice()) === "dark" ? "light" : "dark";
    if (theme === ofDevice()) localStorage.removeItem("theme");
    else localStorage.setItem("theme", theme);
    set();
  });
}
