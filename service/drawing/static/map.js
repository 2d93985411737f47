// The field map by keyboard: one tab stop for the whole map, arrow keys from heliostat to heliostat.
"use strict";
(() => {
  const directions = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  const links = () => [...document.querySelectorAll("[data-map] a")];

  const place = (link) => {
    const circle = link.querySelector("circle");
    return [circle.cx.baseVal.value, circle.cy.baseVal.value];
  };

  // The nearest one that lies in the direction; what lies beside it counts as twice as far.
  const nearest = (from, [dx, dy]) => {
    const [x, y] = place(from);
    let best = null, least = Infinity;
    for (const link of links()) {
      const [a, b] = place(link), along = (a - x) * dx + (b - y) * dy, across = Math.abs((a - x) * dy) + Math.abs((b - y) * dx);
      if (along > 0.5 && along + 2 * across < least) { best = link; least = along + 2 * across; }
    }
    return best;
  };

  const stopAt = (chosen) => links().forEach((link) => link.setAttribute("tabindex", link === chosen ? "0" : "-1"));

  const begin = () => { const all = links(); if (all.length) stopAt(all.find((link) => link === document.activeElement) || all[0]); };

  document.addEventListener("keydown", (event) => {
    const link = event.target.closest && event.target.closest("[data-map] a");
    if (!link || !directions[event.key]) return;
    event.preventDefault();
    const next = nearest(link, directions[event.key]);
    if (next) { stopAt(next); next.focus(); }
  });
  document.addEventListener("htmx:afterSettle", begin);
  begin();
})();
