"""What everything else stands on: arrays, boxes, colours, files, errors, the machine."""
