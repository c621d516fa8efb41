"""What CucumberVision's makers need: drawn scenes, data sets, training, benchmarks."""
