# Everything a person needs: make demo, make test, make quick, make bench, make lint, make grc.
# Set-up happens by itself and is remembered in .venv/stamp-*.

PYTHON := /usr/bin/python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test quick bench lint format examples grc setup setup-dev clean

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

examples: setup-dev
	tools/compile-examples $(BIN)/python

grc: setup
	tools/install-system window
	$(BIN)/gr-ros2 grc-path --install
	gnuradio-companion gr_ros2/examples/ofdm_loopback.grc

setup: $(VENV)/stamp-run
setup-dev: $(VENV)/stamp-dev

$(VENV)/stamp-run: tools/install-system requirements.txt setup.py $(wildcard gr_ros2/phy/kernels/*.cpp gr_ros2/phy/kernels/*.h)
	tools/install-system run
	test -x $(BIN)/pip || $(PYTHON) -m venv --system-site-packages $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-input -r requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-input --no-deps --no-build-isolation -e .
	touch $@

$(VENV)/stamp-dev: $(VENV)/stamp-run requirements-dev.txt
	tools/install-system test
	$(BIN)/pip install --quiet --disable-pip-version-check --no-input -r requirements-dev.txt
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info gr_ros2/phy/kernels/*.so gr_ros2/middleware/*.so
