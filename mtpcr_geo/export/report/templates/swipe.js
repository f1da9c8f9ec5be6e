for (const box of document.querySelectorAll(".swipe")) {
  const slider = box.querySelector("input");
  const move = function () { box.style.setProperty("--at", slider.value + "%"); };
  slider.addEventListener("input", move);
  box.classList.add("on");
  move();
}
