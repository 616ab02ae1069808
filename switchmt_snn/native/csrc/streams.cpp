// Gains of the active dendrites (spiking/dendrites.py), and the heads with the
// combination of their outputs, which is linear, as one matrix; with their gradients. All in single precision.
//
// A actions, M quantiles, O = M * A outputs, the actions of a quantile side by side, N neurons of all streams, one stream
// after the other, R rows (batch, or steps times batch).
// Every sum has one order, so it does not depend on the threads.

#include <algorithm>
#include <cmath>
#include <vector>

#include "numbers.h"

namespace {

struct Head {
    const float *weight, *bias, *combination;  // [M][outputs][inputs], [M][outputs], [outputs][A]
    float *grad_weight, *grad_bias;
    long inputs, outputs;
};

// A neuron's segments that win: their response, how many have it, and the first of them.
struct Winner {
    float response;
    long count, first;
};

Winner winner(const float* responses, long segments, long step, bool absolute) {
    Winner best = {responses[0], 1, 0};
    for (long s = 1; s < segments; s++) {
        float x = responses[s * step], size = absolute ? std::fabs(x) : x;
        float other = absolute ? std::fabs(best.response) : best.response;
        if (size > other || (std::isnan(size) && !std::isnan(other)))
            best = {x, 1, s};
        else if (size == other)
            best.count++;
    }
    return best;
}

inline float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

// Products of COUNT rows [size] with b, side by side; the sum of each has the same order for every COUNT.
template <int COUNT>
void dots(const float* rows, const float* b, long size, float* out) {
    Lanes sums[COUNT] = {};
    auto add = [&](long i, long width) {
        Lanes other = load(b + i, width);
        for (int r = 0; r < COUNT; r++) sums[r] += load(rows + r * size + i, width) * other;
    };
    long i = 0;
    for (; i + WIDTH <= size; i += WIDTH) add(i, WIDTH);
    if (i < size) add(i, size - i);
    for (int r = 0; r < COUNT; r++) {
        out[r] = 0.0f;
        for (long i = 0; i < WIDTH; i++) out[r] += sums[r][i];
    }
}

float dot(const float* a, const float* b, long size) {
    float sum;
    dots<1>(a, b, size, &sum);
    return sum;
}

constexpr long ROWS = 8;  // read out at once, so that a weight is loaded once for all

}  // namespace

extern "C" {

// gain [neurons] = sigmoid of the response to a task that wins, of segments [rows][segments][tasks]; one row is for all.
void snn_gains(const float* weights, long rows, long segments, long tasks, long task, int absolute, float* gain,
               long neurons) {
    for (long row = 0; row < rows; row++)
        gain[row] = sigmoid(winner(weights + row * segments * tasks + task, segments, tasks, absolute).response);
    if (rows == 1) std::fill(gain, gain + neurons, gain[0]);
}

// The segments' gradient; the largest share it if they are equal, of the largest by size the first one has it.
void snn_gains_backward(const float* weights, long rows, long segments, long tasks, long task, int absolute,
                        const float* grad_gain, float* grad_weights, long neurons) {
    std::fill(grad_weights, grad_weights + rows * segments * tasks, 0.0f);
    for (long row = 0; row < rows; row++) {
        const float* responses = weights + row * segments * tasks + task;
        Winner best = winner(responses, segments, tasks, absolute);
        double grad = 0.0;
        for (long n = row; n < (rows == 1 ? neurons : row + 1); n++) grad += grad_gain[n];
        float gain = sigmoid(best.response), share = float(grad) * gain * (1.0f - gain);
        for (long s = 0; s < segments; s++)
            if (absolute ? s == best.first : responses[s * tasks] == best.response)
                grad_weights[(row * segments + s) * tasks + task] = absolute ? share : share / float(best.count);
    }
}

// weight [O][N] and bias [O] of all heads and the combination of their outputs.
void snn_combine_heads(const Head* heads, long count, float* weight, float* bias, long N, long M, long A) {
    std::fill(weight, weight + M * A * N, 0.0f);
    std::fill(bias, bias + M * A, 0.0f);
    for (const Head* head = heads; head < heads + count; weight += head->inputs, head++)
        for (long o = 0; o < M * A; o++)
            for (long j = 0; j < head->outputs; j++) {
                long row = o / A * head->outputs + j;
                float factor = head->combination[j * A + o % A];
                bias[o] += factor * head->bias[row];
                for (long n = 0; n < head->inputs; n++)
                    weight[o * N + n] += factor * head->weight[row * head->inputs + n];
            }
}

// values [R][O] = spikes [R][N] . weight [O][N]^T + bias [O].
void snn_read_out(const float* spikes, const float* weight, const float* bias, float* values, long R, long N, long O,
                  int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
    for (long first = 0; first < R; first += ROWS)
        for (long o = 0; o < O; o++) {
            float sums[ROWS];
            long count = std::min(ROWS, R - first);
            if (count == ROWS)
                dots<ROWS>(spikes + first * N, weight + o * N, N, sums);
            else
                for (long r = 0; r < count; r++) sums[r] = dot(spikes + (first + r) * N, weight + o * N, N);
            for (long r = 0; r < count; r++) values[(first + r) * O + o] = sums[r] + bias[o];
        }
}

// From that of the values [R][O]: gradients of the spikes [R][N], times scale, and of all heads.
void snn_heads_backward(const Head* heads, long count, const float* weight, const float* spikes, const float* grad,
                        float scale, float* grad_spikes, long R, long N, long M, long A, int threads) {
    long O = M * A;
    std::vector<float> totals(O, 0.0f);
    std::vector<long> chosen, starts = {0};  // outputs of each row with a gradient: those of the action that was taken
    for (long r = 0; r < R; r++) {
        for (long o = 0; o < O; o++)
            if (float of_output = grad[r * O + o]; of_output != 0.0f) totals[o] += of_output, chosen.push_back(o);
        starts.push_back(chosen.size());
    }
    long first = 0;
    for (const Head* head = heads; head < heads + count; first += head->inputs, head++) {
        for (long row = 0; row < M * head->outputs; row++) {
            long m = row / head->outputs, j = row % head->outputs;
            head->grad_bias[row] = dot(head->combination + j * A, totals.data() + m * A, A);
        }
#pragma omp parallel num_threads(threads)
        {
            std::vector<Lanes> sums(O);  // of the gradient of the weights [O][N]
#pragma omp for schedule(static)
            for (long c = 0; c < head->inputs; c += WIDTH) {
                long width = std::min(WIDTH, head->inputs - c), n = first + c;
                std::fill(sums.begin(), sums.end(), Lanes{});
                for (long r = 0; r < R; r++) {
                    Lanes of_spikes = {}, spike = load(spikes + r * N + n, width);
                    for (long i = starts[r]; i < starts[r + 1]; i++) {
                        long o = chosen[i];
                        float of_output = grad[r * O + o];
                        sums[o] += spike * of_output;
                        of_spikes += load(weight + o * N + n, width) * of_output;
                    }
                    store(grad_spikes + r * N + n, of_spikes * scale, width);
                }
                for (long row = 0; row < M * head->outputs; row++) {
                    const Lanes* of_quantile = sums.data() + row / head->outputs * A;
                    const float* combination = head->combination + row % head->outputs * A;
                    Lanes sum = {};
                    for (long a = 0; a < A; a++) sum += of_quantile[a] * combination[a];
                    store(head->grad_weight + row * head->inputs + c, sum, width);
                }
            }
        }
    }
}
}
