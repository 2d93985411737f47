// The forecast form: an input selects its option, a time is also shown in the plant's zone, and the result is scrolled
// into view.
"use strict";
(() => {
  const ways = { azimuth_deg: "position", elevation_deg: "position", moment: "time", sun_by: null };

  const showZone = (form) => {
    const output = form.querySelector("[data-zone]"), moment = form.querySelector("[name=moment]").value;
    if (!output) return;
    const at = new Date(`${moment}Z`);
    if (isNaN(at)) { output.textContent = "–"; return; }
    const parts = { year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit" };
    const clock = new Intl.DateTimeFormat("sv-SE", { ...parts, timeZone: output.dataset.zone }).format(at);
    const name = new Intl.DateTimeFormat("en-GB", { timeZone: output.dataset.zone, timeZoneName: "short" }).formatToParts(at);
    output.textContent = `${clock} ${name.find((part) => part.type === "timeZoneName").value}`;
  };

  document.addEventListener("input", (event) => {
    const form = event.target.form;
    if (!form || !(event.target.name in ways)) return;
    const way = ways[event.target.name] || event.target.value;
    form.querySelector(`[name=sun_by][value=${way}]`).checked = true;
    if (way === "position") form.querySelector("[name=moment]").value = "";  // the service rejects both together
    showZone(form);
  });

  document.addEventListener("htmx:afterSettle", (event) => {
    if (event.target.id === "result" && event.target.getBoundingClientRect().top > innerHeight / 2) event.target.scrollIntoView();
  });
})();
