/* A planner's choice in C: reads one message of `roomcast/v1/room-scores`, byte for byte as it lies in shared memory, from a file, and
 * names the room where the robot disturbs least. */
#include <stdio.h>

#include "check.h"
#include "roomcast.h"

/* What comes from another process is checked before it is believed. A probability that is no number fails both comparisons. */
static int is_sound(const RoomcastRoomScoresV1 *scores) {
    if (scores->room_count == 0 || scores->room_count > ROOMCAST_MAX_ROOMS) {
        return 0;
    }
    for (uint32_t index = 0; index < scores->room_count; index++) {
        const RoomcastRoomV1 *room = &scores->room[index];
        if (room->id[0] == 0 || !is_text(room->id, sizeof room->id) ||
            !(room->probability >= 0.0 && room->probability <= 1.0)) {
            return 0;
        }
    }
    return 1;
}

int main(int argc, char **argv) {
    RoomcastRoomScoresV1 scores;
    FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: rooms FILE\n");
        return 2;
    }
    size_t bytes = fread(&scores, 1, sizeof scores, file);
    int more = fgetc(file) != EOF;
    fclose(file);
    if (bytes != sizeof scores || more || !is_sound(&scores)) {
        fprintf(stderr, "rooms: this is no %s\n", ROOMCAST_TYPE_NAME_ROOMSCORESV1);
        return 1;
    }
    const RoomcastRoomV1 *calmest = &scores.room[0];
    for (uint32_t index = 1; index < scores.room_count; index++) {
        if (scores.room[index].probability < calmest->probability) {
            calmest = &scores.room[index];
        }
    }
    printf("scores %llu: go to %.*s (next with %.3f)\n", (unsigned long long)scores.sequence, ROOMCAST_NAME_BYTES,
           (const char *)calmest->id, calmest->probability);
    return 0;
}
