"use strict";
/* What the reader chose in a scenario, behind its place in the address: #clbench/Fetch-v1?across=bytes+kept&sort=learned.
   So the choices survive a reload and the way back, and a link hands them on. */
const choices = (() => {
  const fields = (part) => part.querySelectorAll(".filters :is(select, input), .choices input");
  const nameOf = (field) => (field.name === "division" ? `division ${field.value}` : field.name);
  const titleOf = (head) => head.querySelector("button").firstChild.data.trim();

  /* The place that the address names, and the choices behind it. */
  function address() {
    const [place, query = ""] = location.hash.slice(1).split("?");
    try { return [decodeURIComponent(place), query]; } catch { return ["", ""]; /* "%" alone is no text */ }
  }

  /* Set the fields of a part as the address says, otherwise to their defaults, whatever the browser has restored.
     Return the head of the column that the address sorts by, and the direction. */
  function read(part, heads) {
    const [place, query] = address();
    const chosen = new URLSearchParams(place === part.id ? query : "");
    for (const field of fields(part)) {
      const text = chosen.get(nameOf(field));
      if (field.type === "checkbox") field.checked = text === null ? field.defaultChecked : text === "on";
      else if (field.type === "search") field.value = text ?? "";
      else field.selectedIndex = Math.max([...field.options].findIndex((one) => one.value === text), 0);
    }
    return [heads.find((head) => titleOf(head) === chosen.get("sort")), chosen.get("order")];
  }

  /* Write what differs from the defaults into the address; `head` is the head of a column that the reader chose. */
  function keep(part, head, direction) {
    const chosen = new URLSearchParams();
    for (const field of fields(part)) {
      const isBox = field.type === "checkbox", text = isBox ? (field.checked ? "on" : "off") : field.value;
      const usual = isBox ? field.checked === field.defaultChecked : !text || field.selectedIndex === 0;
      if (!usual) chosen.set(nameOf(field), text);
    }
    if (head) {
      chosen.set("sort", titleOf(head));
      chosen.set("order", direction);
    }
    history.replaceState(history.state, "", `#${[part.id, String(chosen)].filter(Boolean).join("?")}`);
  }

  return { address, read, keep };
})();
