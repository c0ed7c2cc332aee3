"""`python -m hvnet` lists the commands."""

COMMANDS = {
    "detect": "boxes for clouds",
    "train": "train and validate; without arguments the demo, on generated scenes",
    "evaluate": "score KITTI result files of any detector",
    "figures": "draw clouds, labels, detections and pseudo-images",
    "mistakes": "a page of the worst misses and false positives",
    "view": "look at clouds, labels and mistakes in the browser",
    "export": "write ONNX and torch.export files for other programs",
    "study": "rerun the paper's tables and figures",
    "data.synthetic": "generate street scenes in KITTI's layout",
    "data.database": "cut the labelled objects out of a KITTI split",
    "weights": "make the weights of the package anew",
}

if __name__ == "__main__":
    print("HVNet detects cars, pedestrians and cyclists in LiDAR clouds. Commands, each with --help:\n")
    for command, does in COMMANDS.items():
        print(f"  python -m hvnet.{command:<15} {does}")
