// Opens the page, or says why it cannot be.

// What the page says of itself; null where it ends too early.
function readFacts() {
  try {
    return JSON.parse(element("facts").textContent);
  } catch {
    return null;
  }
}

document.addEventListener("DOMContentLoaded", () => {
  const facts = readFacts(), data = element("data")?.textContent ?? "", count = (size) => size.toLocaleString("en");
  if (data.length !== facts?.length) {
    const there = facts ? `${count(data.length)} of ${count(facts.length)} characters of its data are there` : "its end is missing";
    element("status").textContent = `This page is not complete: ${there}. What you see is a still picture.`;
    return;
  }
  const viewer = new Viewer(facts, element("shader").textContent, data);
  for (const name of ["shader", "facts", "data"]) element(name).remove();
  /** @type {any} */ (window).nerfbake = viewer; // for scripts, and for whoever is curious
  viewer.start();
});
element("status").textContent = "Opening";
