# Everything a person needs: make demo, make test, make quick, make bench, make lint, make grc;
# for who publishes it: make wheel, make deb, make release (docs/how-to/release.md).
# Set-up happens by itself: tools/set-up.

VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test quick bench lint format examples pictures grc wheel deb release setup setup-dev clean

demo: setup
	$(BIN)/gr-ros2 demo

test: setup-dev
	$(BIN)/pytest -n auto --dist loadgroup $(PYTEST_ARGS)

quick: setup-dev
	$(BIN)/pytest -n auto --dist loadgroup -m "not slow" $(PYTEST_ARGS)

bench: setup-dev
	$(BIN)/python -m bench

lint: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

pictures: setup-dev
	$(BIN)/python tools/write-pictures

examples: setup-dev
	tools/compile-examples $(BIN)/python

grc: setup
	tools/install-system window
	$(BIN)/gr-ros2 grc-path --install
	mkdir -p results && cp gr_ros2/examples/first_link.grc results/
	GR_CONF_GRC_XTERM_EXECUTABLE="$$(command -v x-terminal-emulator || command -v xterm)" \
		gnuradio-companion results/first_link.grc

wheel: setup
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-release.txt
	@$(BIN)/python tools/make-wheels

deb:
	@tools/make-deb $(ARCHITECTURE)

release: setup
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-release.txt
	@$(BIN)/python tools/release $(VERSION)

setup:
	@tools/set-up run

setup-dev:
	@tools/set-up test

clean:
	rm -rf $(VENV) build dist *.egg-info gr_ros2/phy/kernels/*.so gr_ros2/middleware/*.so
