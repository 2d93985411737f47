// Keys of the review of photographs: each presses the button, link or field that names it.
"use strict";
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const field = event.target.closest?.("input, select, textarea");
  if (field) {
    if (event.key === "Escape" || event.key === "Enter") field.blur();
    return;
  }
  const named = document.querySelector(`main [data-key="${CSS.escape(event.key.toLowerCase())}"]`);
  if (!named) return;
  event.preventDefault();
  if (named.matches("select")) named.focus(); else named.click();
});
