// Show that the service does not respond, and reconnect when it does.
"use strict";
(() => {
  const RETRY_MS = 2000;
  let isProbing = false;

  const answers = async () => {
    try { return (await fetch("/livez", { cache: "no-store" })).ok; } catch { return false; }
  };

  // A listener of a job may have missed its last event.
  const refresh = () => document.querySelectorAll('[hx-trigger*="sse:"]').forEach((one) => htmx.trigger(one, "sse:progress"));

  const probe = async () => {
    if (isProbing) return;
    isProbing = true;
    const notice = document.getElementById("connection");
    while (!(await answers())) {
      notice.textContent = "Connection to the service lost; retrying";
      notice.className = "alert";
      await new Promise((done) => setTimeout(done, RETRY_MS));
    }
    isProbing = false;
    if (!notice.textContent) return;
    notice.textContent = notice.className = "";
    refresh();
  };

  for (const event of ["htmx:sseError", "htmx:sendError"]) document.addEventListener(event, probe);
})();
