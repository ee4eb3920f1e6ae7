// Tells the server which driving keys are held down, over a socket of the page's own; the view behind gets none of them.
(() => {
  const DRIVING = new Set(["KeyW", "KeyA", "KeyS", "KeyD", "ArrowUp", "ArrowLeft", "ArrowDown", "ArrowRight", "Space"]);
  const held = new Set();
  let socket = null, page = null;
  const tell = () => socket?.readyState === WebSocket.OPEN && socket.send(JSON.stringify([...held]));
  const typing = (target) => target.matches?.("input:not([type=checkbox]):not([type=range]), textarea, select");

  function press(event, down) {
    if (!DRIVING.has(event.code)) return;
    if (down && (event.ctrlKey || event.metaKey || event.altKey || typing(event.target))) return;
    if (down) {
      event.preventDefault();
      event.stopImmediatePropagation();
    }
    if (down === held.has(event.code)) return;
    down ? held.add(event.code) : held.delete(event.code);
    tell();
  }
  function release() {
    held.clear();
    tell();
  }
  window.addEventListener("keydown", (event) => press(event, true), true);
  window.addEventListener("keyup", (event) => press(event, false), true);
  window.addEventListener("blur", release);
  document.addEventListener("visibilitychange", () => document.hidden && release());

  setInterval(() => {  // a page that lost its server and found it again has another name
    const name = document.querySelector("[data-live-page]")?.dataset.livePage;
    if (!name || (name === page && socket?.readyState <= WebSocket.OPEN)) return;
    page = name;
    socket?.close();
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/keys/${name}`);
    socket.onopen = tell;
  }, 250);
})();
