// The field map by keyboard: one tab stop for the whole map, arrow keys from heliostat to heliostat. A tap beside a
// heliostat means it, for fingers are wider than circles.
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
  document.addEventListener("click", (event) => {
    const map = event.target.closest("[data-map]"), all = links();
    if (!map || event.target.closest("a") || !all.length) return;
    const drawn = map.getScreenCTM(), at = new DOMPoint(event.clientX, event.clientY).matrixTransform(drawn.inverse());
    const far = (link) => { const [x, y] = place(link); return Math.hypot(x - at.x, y - at.y) * drawn.a; };
    const best = all.reduce((one, other) => (far(other) < far(one) ? other : one));
    if (far(best) <= 20) location.assign(best.href.baseVal);
  });
  document.addEventListener("htmx:afterSettle", begin);
  begin();
})();
