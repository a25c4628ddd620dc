// A line of the log, pressed, shows its time; the camera's picture follows the shown time.
(() => {
  "use strict";
  const PERIOD = 150; // [ms]
  const show = (id, properties) => window.dash_clientside.set_props(id, properties);

  document.addEventListener("click", (event) => {
    const line = event.target.closest("#log [data-time]");
    if (line) show("time", { value: Number(line.dataset.time) });
  });

  // A picture takes a while: the next one is asked for when it is there, and none while nobody looks.
  let shown = "", url = "", busy = false;
  setInterval(async () => {
    const wanted = document.querySelector("#camera[open] #camera-at")?.textContent;
    if (busy || !wanted || wanted === shown || document.hidden) return;
    busy = true;
    try {
      const answer = await fetch(`camera/${wanted}`);
      const isPicture = answer.ok && answer.headers.get("Content-Type") === "image/png";
      const before = url;
      url = isPicture ? URL.createObjectURL(await answer.blob()) : "";
      show("camera-picture", { src: url });
      show("camera-said", { children: isPicture ? "" : await answer.text() });
      URL.revokeObjectURL(before);
      shown = wanted;
    } catch {} // the server is gone: stop.js says so
    busy = false;
  }, PERIOD);
})();
