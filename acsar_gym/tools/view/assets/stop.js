// The stop button asks the server itself, past Dash, which is drawing or waits for something else;
// and whoever looks at a page whose server doesn't answer is told that it is old.
(() => {
  "use strict";
  const LOST = "not confirmed, the dashboard doesn't answer: run acsar-gym estop in a terminal";
  const HEARD = 1000, LONGEST = 5000; // [ms]
  const TOKEN = "stop-token"; // by which the server knows that its own page asks
  let busy = false, lost = false, server = null;

  const show = (id, properties) => window.dash_clientside.set_props(id, properties);

  async function ask(path, method) {
    const headers = { [TOKEN]: document.querySelector(`meta[name=${TOKEN}]`).content };
    const answer = await fetch(path, { method, headers, signal: AbortSignal.timeout(LONGEST) });
    if (!answer.ok) throw new Error(answer.status);
    return answer.text();
  }

  async function stop() {
    if (busy) return;
    busy = true;
    const answer = ask("stop", "POST").catch(() => LOST);
    show("stop", { children: "Stopping \u2026", className: "stop busy" });
    show("stop-said", { children: await answer });
    show("stop", { children: "Stop robot", className: "stop" });
    busy = false;
  }

  // A mouse or a finger stops when it goes down, not when it is lifted; keys make a click without.
  const isStop = (event) => event.target.closest("#stop") && !event.button;
  document.addEventListener("pointerdown", (event) => isStop(event) && stop());
  document.addEventListener("click", (event) => isStop(event) && !event.detail && stop());

  setInterval(async () => {
    let found;
    try {
      found = await ask("alive", "GET");
    } catch {
      lost = true;
      document.body.classList.add("lost");
      return;
    }
    server ??= found;
    // Dash doesn't ask again after such an error.
    if ((lost || found !== server) && !busy) location.reload();
  }, HEARD);
})();
