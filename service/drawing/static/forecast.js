// The forecast form: an input selects its option, and the result is scrolled into view.
"use strict";
(() => {
  const ways = { azimuth_deg: "position", elevation_deg: "position", moment: "time", sun_by: null };

  document.addEventListener("input", (event) => {
    const form = event.target.form;
    if (!form || !(event.target.name in ways)) return;
    const way = ways[event.target.name] || event.target.value;
    form.querySelector(`[name=sun_by][value=${way}]`).checked = true;
    if (way === "position") form.querySelector("[name=moment]").value = "";  // the service rejects both together
  });

  document.addEventListener("htmx:afterSettle", (event) => {
    if (event.target.id === "result" && event.target.getBoundingClientRect().top > innerHeight / 2) event.target.scrollIntoView();
  });
})();
